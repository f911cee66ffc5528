"""The pieces of a head, and the file that ``services.driver.head.head`` reads.

Eyeballs are made here, because MakeHuman's eyeballs are too coarse.

All lengths are MakeHuman decimeters, y up, z toward the viewer, x to the subject's left.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kouxing.services.driver.head.head import FORMAT
from kouxing.services.driver.head.import_head import MAX_VERTICES
from kouxing.shared.arrays import Doubles, Floats, Integers, Mask
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import open_output
from kouxing.training.heads import subdivision
from kouxing.training.heads.fitted_mesh import FittedMesh
from kouxing.training.heads.makehuman import FEATURE_POINTS, METERS_PER_UNIT, PIVOT, BaseMesh
from kouxing.training.heads.measures import eye_centers, eye_radius
from kouxing.training.heads.zones import Fields, Skin, jaw_fields, tongue_fields


@dataclass(slots=True)
class Geometry:
    """Vertices and triangles of a ``HeadPiece``."""

    vertices: Doubles  # (V, 3)
    triangles: Integers  # (F, 3)
    uv: Doubles  # (V, 2), v downward as in glTF
    colors: Doubles  # (V, 3) linear factors on the texture
    welds: Integers | None = None  # (V,) first vertex at each position; None: all positions differ


def grid_triangles(rows: int, columns: int) -> Integers:
    """Triangulate a grid of ``rows * columns`` vertices, row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    halves = [
        np.stack([corner, corner + columns, corner + columns + 1], axis=1),
        np.stack([corner, corner + columns + 1, corner + 1], axis=1),
    ]
    return np.stack(halves, axis=1).reshape(-1, 3)


IRIS_ANGLE = np.radians(25.0)  # half of the iris, seen from the eye's center
PUPIL_ANGLE = np.radians(9.5)
# rings of vertices from the front pole backward; ring 2 is the pupil's edge, ring 6 the iris's
EYE_RINGS = np.radians([0.0, 5.0, 9.5, 13.0, 17.0, 21.0, 25.0, 30.0, 38.0, 48.0, 60.0, 75.0, 95.0])
_EYE_SEGMENTS = 32


def eyeball(center: Doubles, radius: float) -> Geometry:
    """Make a sphere, open at the back; its texture is a view from the front."""
    turn = np.linspace(0.0, 2 * np.pi, _EYE_SEGMENTS + 1)
    angle, turn = np.meshgrid(EYE_RINGS, turn, indexing="ij")
    bulge = 1.0 + 0.035 * np.clip(1 - angle / np.radians(32.0), 0, 1)  # the cornea
    direction = np.stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=2
    )
    vertices = center + radius * (bulge[..., None] * direction).reshape(-1, 3)
    reach = (angle / EYE_RINGS[-1]).ravel()  # the texture's radius is proportional to the angle
    uv = 0.5 + 0.5 * np.stack([reach * np.cos(turn).ravel(), -reach * np.sin(turn).ravel()], axis=1)
    triangles = grid_triangles(*angle.shape)
    return Geometry(vertices, triangles, uv, np.ones((len(vertices), 3)))


def pupil_growth(geometry: Geometry, center: Doubles) -> Doubles:
    """Return radial directions (V, 3), of unit length at the pupil's edge, for FAPs 29 and 30."""
    angle = np.repeat(EYE_RINGS, _EYE_SEGMENTS + 1)
    weight = np.interp(angle, [0.0, PUPIL_ANGLE, IRIS_ANGLE], [0.0, 1.0, 0.0])
    outward = (geometry.vertices - center) * [1.0, 1.0, 0.0]
    length = np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    return np.asarray(weight[:, None] * outward / length)


_FIRST_UPPER_TOOTH = 15060  # vertex of the base mesh; the lower teeth come before
_TEETH_DEPTH = 0.29  # depth of the rows; the molars behind are never seen
TRANSPARENT = ("brows", "lashes", "hair")


@dataclass(slots=True)
class HeadPiece:
    """A mesh of the head with its material and motion."""

    name: str
    geometry: Geometry
    texture: str
    roughness: float
    head_weight: Doubles  # (V,)
    fields: Fields = field(default_factory=dict)  # FAP -> (V, 3), dm at 1 FAPU or 1 rad
    coarse_vertices: int = 0  # 0: there is only one level of detail
    coarse_triangles: Integers | None = None

    def keep(self, mask: Mask) -> None:
        """Remove the other triangles (F,) of a piece without coarse ones, and unused vertices."""
        old = self.geometry
        used, triangles, welds = subdivision.used_vertices(old.triangles[mask], _welds(old))
        self.geometry = Geometry(
            old.vertices[used], triangles, old.uv[used], old.colors[used], welds
        )
        self.head_weight = self.head_weight[used]
        self.fields = {fap: shift[used] for fap, shift in self.fields.items()}


def _welds(geometry: Geometry) -> Integers:
    return np.arange(len(geometry.vertices)) if geometry.welds is None else geometry.welds


def write(
    output: Path,
    pieces: list[HeadPiece],
    textures: dict[str, bytes],
    skin: Skin,
    tongue: Skin,
    fapu: dict[str, float],
    *,
    cel: bool,
) -> None:
    """Write a head, converting dm to m; ``cel`` as in ``Head``.

    Raises ``UserError`` if it has too many vertices.
    """

    def meters(points: Doubles) -> Floats:
        return np.asarray((points - PIVOT) * METERS_PER_UNIT, dtype=np.float32)

    first = np.cumsum([0] + [len(p.geometry.vertices) for p in pieces])
    if first[-1] > MAX_VERTICES:
        raise UserError(f"{output}: the head has {first[-1]} vertices; use at most {MAX_VERTICES}")
    start = {p.name: int(offset) for p, offset in zip(pieces, first, strict=False)}
    part_vertices, part_triangles, triangles = [], [], []
    count = 0
    for piece in pieces:
        offset, size = start[piece.name], len(piece.geometry.vertices)
        end_coarse = offset + (piece.coarse_vertices or size)
        part_vertices.append((offset, end_coarse, offset + size))
        triangles.append(piece.geometry.triangles + offset)
        fine = (count, count + len(triangles[-1]))
        count = fine[1]
        coarse = fine
        if piece.coarse_triangles is not None:
            triangles.append(piece.coarse_triangles + offset)
            coarse = (count, count + len(triangles[-1]))
            count = coarse[1]
        part_triangles.append((*fine, *coarse))

    eyes = [p.geometry for p in pieces if p.name.startswith("eye")]
    points = {
        name: start[piece] + int(surface.number[vertex])
        for piece, surface in (("skin", skin), ("tongue", tongue))
        for name, vertex in FEATURE_POINTS.items()
        if surface.number[vertex] >= 0
    }
    points |= {"3.5": start["eye_left"], "3.6": start["eye_right"]}
    for name, edge, root in (("teeth_upper", "9.10", "9.8"), ("teeth_lower", "9.11", "9.9")):
        row = next(piece.geometry for piece in pieces if piece.name == name)
        at_edge, at_root = middle_of_teeth(row, is_upper=name == "teeth_upper")
        points |= {edge: start[name] + at_edge, root: start[name] + at_root}
    vertices = np.concatenate([p.geometry.vertices for p in pieces])
    fapu = {name: value * METERS_PER_UNIT for name, value in fapu.items()} | {"AU": 1e-5}

    faps = sorted({fap for piece in pieces for fap in piece.fields})
    bounds, moved, shifts = [0], [], []
    for fap in faps:
        for piece in pieces:
            if fap in piece.fields:
                shift = piece.fields[fap] * METERS_PER_UNIT
                rows = np.flatnonzero(np.abs(shift).max(axis=1) > 2e-6)
                moved.append(rows + start[piece.name])
                shifts.append(shift[rows])
        bounds.append(sum(len(rows) for rows in moved))
    centers = meters(np.stack([(e.vertices.max(0) + e.vertices.min(0)) / 2 for e in eyes]))
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "cel": np.array(cel),
        "vertices": meters(vertices),
        "uv": np.round(np.concatenate([p.geometry.uv for p in pieces]) * 65535).astype(np.uint16),
        "colors": np.round(
            np.sqrt(np.clip(np.concatenate([p.geometry.colors for p in pieces]), 0, 1)) * 255
        ).astype(np.uint8),
        "head_weight": np.round(np.concatenate([p.head_weight for p in pieces]) * 255).astype(
            np.uint8
        ),
        "triangles": np.concatenate(triangles).astype(np.uint16),
        "part_names": np.array([p.name for p in pieces]),
        "part_textures": np.array([p.texture for p in pieces]),
        "part_roughness": np.array([p.roughness for p in pieces]),
        "part_transparent": np.array([p.name in TRANSPARENT for p in pieces]),
        "part_double_sided": np.array([p.name in TRANSPARENT for p in pieces]),
        "welds": np.concatenate([_welds(p.geometry) + start[p.name] for p in pieces]).astype(
            np.uint16
        ),
        "part_vertices": np.array(part_vertices),
        "part_triangles": np.array(part_triangles),
        "fapu_names": np.array(list(fapu)),
        "fapu": np.array(list(fapu.values())),
        "feature_point_names": np.array(list(points)),
        "feature_points": np.array(list(points.values())),
        "eye_centres": centers,
        "field_faps": np.array(faps, dtype=np.int64),
        "field_units": np.array([1e5 if fap == 47 else 1024.0 for fap in faps]),
        "field_bounds": np.array(bounds),
        "field_vertices": np.concatenate([*moved, np.zeros(0, int)]).astype(np.uint16),
        "field_shifts": np.concatenate([*shifts, np.zeros((0, 3))]).astype(np.float16),
    }
    for name, data in textures.items():
        arrays[f"texture_{name}"] = np.frombuffer(data, np.uint8)
    with open_output(output) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def eye_pieces(vertices: Doubles, mesh: BaseMesh, fapu: dict[str, float]) -> list[HeadPiece]:
    """Make the eyeballs; they can move forward, and their pupils can grow."""
    pieces = []
    for row, name in enumerate(("eye_left", "eye_right")):
        center = eye_centers(vertices, mesh)[row]
        geometry = eyeball(center, eye_radius(vertices, mesh))
        count = len(geometry.vertices)
        fields = {
            27 + row: np.tile([0.0, 0.0, fapu["ES"]], (count, 1)),
            29 + row: pupil_growth(geometry, center) * fapu["IRISD"] / 2,
        }
        pieces.append(HeadPiece(name, geometry, "eye", 0.12, np.ones(count), fields))
    return pieces


def teeth_pieces(teeth: FittedMesh, vertices: Doubles, fapu: dict[str, float]) -> list[HeadPiece]:
    """Make the upper and the lower teeth; the lower teeth move with the jaw.

    ``vertices`` (19158, 3) is the base mesh's shape for which the mouth is laid out.
    """
    pieces = []
    is_lower = teeth.base[teeth.triangles[:, 0], 0] < _FIRST_UPPER_TOOTH
    depth = teeth.fit(vertices)[teeth.triangles, 2].mean(axis=1)
    for name, in_row, edge, front in (
        ("teeth_upper", ~is_lower, 5.144, 1.238),
        ("teeth_lower", is_lower, 5.146, 1.206),
    ):
        row = teeth.keep_triangles(in_row & (depth > depth[in_row].max() - _TEETH_DEPTH))
        points = row.fit(vertices)
        geometry = Geometry(points, row.triangles, row.uv, np.ones_like(points), row.welds)
        middle = points[middle_of_teeth(geometry, is_upper=name == "teeth_upper")[0]]
        geometry.vertices = points - [0, middle[1] - edge, middle[2] - front]
        still = np.ones(len(points))
        fields = jaw_fields(geometry.vertices, still, fapu) if name == "teeth_lower" else {}
        pieces.append(HeadPiece(name, geometry, "teeth", 0.3, still, fields))
    return pieces


def middle_of_teeth(row: Geometry, *, is_upper: bool) -> tuple[int, int]:
    """Find the vertices between the middle teeth, at the cutting edge and at the gum."""
    x, y, z = row.vertices.T
    front = np.flatnonzero((np.abs(x) < 0.05) & (z > z.max() - 0.05))
    order = front[np.argsort(y[front])]
    return (int(order[0]), int(order[-1])) if is_upper else (int(order[-1]), int(order[0]))


def tongue_piece(tongue: Skin, fapu: dict[str, float]) -> HeadPiece:
    """Make the tongue: wide, flat behind the lower teeth, grooved along its middle."""
    x, y, z = tongue.vertices.T
    top = np.clip((y - 5.15) / 0.05, 0, 1)
    to_tip = np.clip((z - 0.56) / 0.59, 0, 1)
    groove = 0.014 * np.exp(-((x / 0.045) ** 2)) * top * np.clip(3 * (1 - to_tip), 0, 1)
    sunk = 0.110 - 0.052 * to_tip**2 + groove + 0.02 * np.abs(x) / 0.19
    points = np.stack([1.28 * x, y - sunk, z - 0.03], axis=1)
    uv = np.clip(points[:, [0, 2]] * [1.8, 1.4] + [0.5, -0.65], 0, 1)
    geometry = Geometry(points, subdivision.triangles_of(tongue.quads), uv, np.ones_like(points))
    return HeadPiece(
        "tongue",
        geometry,
        "tongue",
        0.4,
        np.ones(len(points)),
        tongue_fields(tongue, fapu),
        coarse_vertices=len(tongue.base),
        coarse_triangles=subdivision.triangles_of(tongue.coarse_quads),
    )
