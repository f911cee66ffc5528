"""The pieces of a head, and the file that ``services.driver.head.head`` reads.

Eyeballs and teeth are made here, because MakeHuman's base mesh lacks them or has them too coarse.

All lengths are MakeHuman decimeters, y up, z toward the viewer, x to the subject's left.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver.head.head import FORMAT
from kouxing.training.heads import subdivision
from kouxing.training.heads.makehuman import FEATURE_POINTS, METERS_PER_UNIT, PIVOT, BaseMesh
from kouxing.training.heads.measures import eye_centers, eye_radius
from kouxing.training.heads.zones import Fields, Skin, jaw_fields, tongue_fields

Float = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(slots=True)
class Geometry:
    """Geometry of one piece of the head."""

    vertices: Float  # (V, 3)
    triangles: Index  # (F, 3)
    uv: Float  # (V, 2), v downward as in glTF
    colors: Float  # (V, 3) linear factors on the texture


def grid_triangles(rows: int, columns: int) -> Index:
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


def eyeball(center: Float, radius: float) -> Geometry:
    """Make a sphere, open at the back; its texture is a view from the front."""
    turn = np.linspace(0.0, 2 * np.pi, _EYE_SEGMENTS + 1)
    angle, turn = np.meshgrid(EYE_RINGS, turn, indexing="ij")
    bulge = 1.0 + 0.035 * np.clip(1 - angle / np.radians(32.0), 0, 1) ** 1.0  # the cornea
    direction = np.stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=2
    )
    vertices = center + radius * (bulge[..., None] * direction).reshape(-1, 3)
    reach = (angle / EYE_RINGS[-1]).ravel()  # the texture's radius is proportional to the angle
    uv = 0.5 + 0.5 * np.stack([reach * np.cos(turn).ravel(), -reach * np.sin(turn).ravel()], axis=1)
    triangles = grid_triangles(*angle.shape)
    return Geometry(vertices, triangles, uv, np.ones((len(vertices), 3)))


def pupil_growth(part: Geometry, center: Float) -> Float:
    """Return radial directions (V, 3), of unit length at the pupil's edge, for FAPs 29 and 30."""
    angle = np.repeat(EYE_RINGS, _EYE_SEGMENTS + 1)
    weight = np.interp(angle, [0.0, PUPIL_ANGLE, IRIS_ANGLE], [0.0, 1.0, 0.0])
    outward = (part.vertices - center) * [1.0, 1.0, 0.0]
    length = np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    return np.asarray(weight[:, None] * outward / length)


# widths in mm from the middle outward: incisors, canine, premolars, molars
UPPER_TEETH = (8.4, 6.6, 7.4, 6.8, 6.6, 9.5, 9.0)
LOWER_TEETH = (5.4, 5.8, 6.6, 6.9, 7.0, 10.0, 9.5)
_TOOTH_COLUMNS = 6
_ARCH_HALF_WIDTH, _ARCH_DEPTH = 0.300, 0.44  # of half an ellipse, dm
# profile of a row of teeth from the front gum over the cutting edge to the back:
# (outward, away from the edge, texture row)
_PROFILE = np.array(
    [
        [-0.035, 0.185, 0.00],
        [-0.004, 0.135, 0.16],
        [0.006, 0.095, 0.32],
        [0.006, 0.055, 0.48],
        [0.000, 0.018, 0.62],
        [-0.008, 0.002, 0.70],
        [-0.022, 0.004, 0.76],
        [-0.042, 0.045, 0.84],
        [-0.060, 0.130, 1.00],
    ]
)


def tooth_row(widths: tuple[float, ...], edge_y: float, front_z: float, up: float) -> Geometry:
    """Sweep the profile of a tooth along the dental arch.

    ``widths`` are those of one half in mm, outward. The cutting edge of the front teeth is at
    ``edge_y`` and ``front_z``. ``up`` is 1 if the gum is above the edge, -1 if below.
    """
    half = np.concatenate([[0.0], np.cumsum(widths)]) / 100.0
    bounds = np.concatenate([-half[:0:-1], half])
    place = np.concatenate(
        [np.linspace(a, b, _TOOTH_COLUMNS, endpoint=False) for a, b in pairwise(bounds)]
        + [bounds[-1:]]
    )
    phase = np.concatenate([np.tile(np.arange(_TOOTH_COLUMNS), 2 * len(widths)), [0]])
    swell = np.sin(np.pi * phase / _TOOTH_COLUMNS)  # 0 between two teeth, 1 in the middle of one

    # the arch: half an ellipse, parametrized by its length
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2001)
    arch = np.stack([_ARCH_HALF_WIDTH * np.sin(angle), _ARCH_DEPTH * np.cos(angle)], axis=1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(arch, axis=0), axis=1))])
    length -= length[-1] / 2
    at = np.interp(place, length, angle)
    x, z = _ARCH_HALF_WIDTH * np.sin(at), front_z - _ARCH_DEPTH + _ARCH_DEPTH * np.cos(at)
    outward = np.stack(
        [np.sin(at) / _ARCH_HALF_WIDTH, np.zeros_like(at), np.cos(at) / _ARCH_DEPTH], axis=1
    )
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)

    back = np.abs(place) / half[-1]
    rows = []
    for out, away, _ in _PROFILE:
        on_tooth = np.clip(1 - away / 0.1, 0, 1)
        lift = away + 0.010 * (1 - swell) ** 2 * np.clip(1 - away / 0.03, 0, 1)
        lift = lift + 0.012 * back**2  # the row rises toward the molars
        push = out + 0.010 * (swell - 1) * (0.3 + on_tooth)
        point = np.stack([x, edge_y + up * lift, z], axis=1) + outward * push[:, None]
        rows.append(point)
    vertices = np.concatenate(rows)
    columns = len(place)
    uv = np.stack(
        [np.tile(place / half[-1] * 0.5 + 0.5, len(rows)), np.repeat(_PROFILE[:, 2], columns)],
        axis=1,
    )
    triangles = grid_triangles(len(rows), columns)
    if up > 0:
        triangles = triangles[:, ::-1]
    shade = np.clip(1.0 - 0.95 * np.tile(back, len(rows)) ** 1.2, 0.06, 1.0)
    by_row = np.interp(_PROFILE[:, 2], [0.0, 0.3, 0.7, 1.0], [0.45, 0.9, 1.0, 0.4])
    shade *= np.repeat(by_row, columns)
    return Geometry(vertices, triangles, uv, np.repeat(shade[:, None], 3, axis=1))


def middle_of_teeth(row: Geometry) -> tuple[int, int]:
    """Find the vertices between the middle teeth, at the cutting edge and at the gum."""
    columns = len(row.vertices) // len(_PROFILE)
    edge = int(np.argmin(np.abs(_PROFILE[:, 1])))
    return edge * columns + columns // 2, columns // 2


TRANSPARENT = ("hair_tips", "lashes")


@dataclass(slots=True)
class HeadPiece:
    """A part with its material and motion."""

    name: str
    part: Geometry
    texture: str
    roughness: float
    head_weight: Float  # (V,)
    fields: Fields = field(default_factory=dict)  # FAP -> (V, 3), dm at 1 FAPU or 1 rad
    coarse_vertices: int = 0  # 0: there is only one level of detail
    coarse_triangles: Index | None = None


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
    """Write a head, converting dm to m; ``cel`` as in ``Head``."""

    def meters(points: Float) -> NDArray[np.float32]:
        return np.asarray((points - PIVOT) * METERS_PER_UNIT, dtype=np.float32)

    first = np.cumsum([0] + [len(p.part.vertices) for p in pieces])
    start = {p.name: int(at) for p, at in zip(pieces, first, strict=False)}
    part_vertices, part_triangles, triangles = [], [], []
    count = 0
    for piece in pieces:
        at, size = start[piece.name], len(piece.part.vertices)
        part_vertices.append((at, at + (piece.coarse_vertices or size), at + size))
        triangles.append(piece.part.triangles + at)
        fine = (count, count + len(triangles[-1]))
        count = fine[1]
        coarse = fine
        if piece.coarse_triangles is not None:
            triangles.append(piece.coarse_triangles + at)
            coarse = (count, count + len(triangles[-1]))
            count = coarse[1]
        part_triangles.append((*fine, *coarse))

    eyes = [p.part for p in pieces if p.name.startswith("eye")]
    points = {
        name: start["skin"] + int(skin.number[vertex])
        for name, vertex in FEATURE_POINTS.items()
        if skin.number[vertex] >= 0
    }
    points |= {
        name: start["tongue"] + int(tongue.number[vertex])
        for name, vertex in FEATURE_POINTS.items()
        if tongue.number[vertex] >= 0
    }
    points |= {"3.5": start["eye_left"], "3.6": start["eye_right"]}
    for piece, edge, root in ((pieces[4], "9.10", "9.8"), (pieces[5], "9.11", "9.9")):
        at_edge, at_root = middle_of_teeth(piece.part)
        points |= {edge: start[piece.name] + at_edge, root: start[piece.name] + at_root}
    vertices = np.concatenate([p.part.vertices for p in pieces])
    fapu = {name: value * METERS_PER_UNIT for name, value in fapu.items()} | {"AU": 1e-5}

    faps, units, bounds, moved, shifts = [], [], [0], [], []
    for fap in sorted({fap for piece in pieces for fap in piece.fields}):
        for piece in pieces:
            if fap in piece.fields:
                shift = piece.fields[fap] * METERS_PER_UNIT
                rows = np.flatnonzero(np.abs(shift).max(axis=1) > 2e-6)
                moved.append(rows + start[piece.name])
                shifts.append(shift[rows])
        faps.append(fap)
        units.append(1e5 if fap == 47 else 1024.0)
        bounds.append(sum(len(rows) for rows in moved))
    centers = meters(np.stack([(e.vertices.max(0) + e.vertices.min(0)) / 2 for e in eyes]))
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "cel": np.array(cel),
        "vertices": meters(vertices),
        "uv": np.round(np.concatenate([p.part.uv for p in pieces]) * 65535).astype(np.uint16),
        "colors": np.round(
            np.sqrt(np.clip(np.concatenate([p.part.colors for p in pieces]), 0, 1)) * 255
        ).astype(np.uint8),
        "head_weight": np.round(np.concatenate([p.head_weight for p in pieces]) * 255).astype(
            np.uint8
        ),
        "triangles": np.concatenate(triangles).astype(np.uint16),
        "part_names": np.array([p.name for p in pieces]),
        "part_textures": np.array([p.texture for p in pieces]),
        "part_roughness": np.array([p.roughness for p in pieces]),
        "part_transparent": np.array([p.name in TRANSPARENT for p in pieces]),
        "part_double_sided": np.array([p.texture in ("hair", "lashes") for p in pieces]),
        "part_vertices": np.array(part_vertices),
        "part_triangles": np.array(part_triangles),
        "fapu_names": np.array(list(fapu)),
        "fapu": np.array(list(fapu.values())),
        "feature_point_names": np.array(list(points)),
        "feature_points": np.array(list(points.values())),
        "eye_centres": centers,
        "field_faps": np.array(faps, dtype=np.int64),
        "field_units": np.array(units),
        "field_bounds": np.array(bounds),
        "field_vertices": np.concatenate([*moved, np.zeros(0, int)]).astype(np.uint16),
        "field_shifts": np.concatenate([*shifts, np.zeros((0, 3))]).astype(np.float16),
    }
    for name, data in textures.items():
        arrays[f"texture_{name}"] = np.frombuffer(data, np.uint8)
    np.savez_compressed(output, allow_pickle=False, **arrays)


def eye_pieces(vertices: Float, mesh: BaseMesh, fapu: dict[str, float]) -> list[HeadPiece]:
    """Make the eyeballs; they can move forward, and their pupils can grow."""
    pieces = []
    for row, name in enumerate(("eye_left", "eye_right")):
        center = eye_centers(vertices, mesh)[row]
        part = eyeball(center, eye_radius(vertices, mesh))
        count = len(part.vertices)
        fields = {
            27 + row: np.tile([0.0, 0.0, fapu["ES"]], (count, 1)),
            29 + row: pupil_growth(part, center) * fapu["IRISD"] / 2,
        }
        pieces.append(HeadPiece(name, part, "eye", 0.12, np.ones(count), fields))
    return pieces


def teeth_pieces(fapu: dict[str, float]) -> list[HeadPiece]:
    """Make the upper and the lower teeth; the lower teeth move with the jaw."""
    pieces = []
    for name, widths, edge, front, up in (
        ("teeth_upper", UPPER_TEETH, 5.144, 1.238, 1.0),
        ("teeth_lower", LOWER_TEETH, 5.146, 1.206, -1.0),
    ):
        part = tooth_row(widths, edge, front, up)
        still = np.ones(len(part.vertices))
        fields = jaw_fields(part.vertices, still, fapu) if up < 0 else {}
        pieces.append(HeadPiece(name, part, name, 0.35, still, fields))
    return pieces


def tongue_piece(tongue: Skin, fapu: dict[str, float]) -> HeadPiece:
    """Make the tongue: wide, flat behind the lower teeth, grooved along its middle."""
    x, y, z = tongue.vertices.T
    top = np.clip((y - 5.15) / 0.05, 0, 1)
    to_tip = np.clip((z - 0.56) / 0.59, 0, 1)
    groove = 0.014 * np.exp(-((x / 0.045) ** 2)) * top * np.clip(3 * (1 - to_tip), 0, 1)
    sunk = 0.110 - 0.052 * to_tip**2 + groove + 0.02 * np.abs(x) / 0.19
    points = np.stack([1.28 * x, y - sunk, z - 0.03], axis=1)
    uv = np.clip(points[:, [0, 2]] * [1.8, 1.4] + [0.5, -0.65], 0, 1)
    part = Geometry(points, subdivision.triangles_of(tongue.quads), uv, np.ones_like(points))
    return HeadPiece(
        "tongue",
        part,
        "tongue",
        0.4,
        np.ones(len(points)),
        tongue_fields(tongue, fapu),
        coarse_vertices=len(tongue.base),
        coarse_triangles=subdivision.triangles_of(tongue.coarse_quads),
    )
