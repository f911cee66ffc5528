"""Assemble a head.

Every head is a shape of one mesh. Zones, texture, teeth, tongue and hair are laid out by hand on
the reference head, in dm, and transferred to the same vertices of the other heads.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate

from kouxing.training.heads import paint, paint_parts, parts, subdivision
from kouxing.training.heads.hair import coarse_locks, join
from kouxing.training.heads.hair_styles import Crop
from kouxing.training.heads.makehuman import FEATURE_POINTS, PIVOT, MakeHuman
from kouxing.training.heads.measures import (
    eye_sockets,
    head_weight,
    lip_outline,
    measure_fapu,
    mouth_cavity,
    neckline_height,
)
from kouxing.training.heads.occlusion import shade
from kouxing.training.heads.paint_parts import encode
from kouxing.training.heads.parts import HeadPiece, eye_pieces, teeth_pieces, tongue_piece, write
from kouxing.training.heads.people import REFERENCE, Person, Shape
from kouxing.training.heads.zones import FaceFields, Fields, Skin, close_lips, subdivided

Float = NDArray[np.float64]
Index = NDArray[np.int64]

LOWEST = 3.1  # lower end of the bust, dm
# the neckband, as rings around the garment's edge: outward and up, dm
_NECKBAND = (
    (0.036, 0.000),
    (0.046, 0.014),
    (0.044, 0.044),
    (0.026, 0.056),
    (0.010, 0.03),
    (0.0, -0.04),
)
# the front edge of the left upper eyelid, from the nose outward
LEFT_LID = (6886, 6844, 6841, 6838, 6785, 6784, 6790, 6793, 6796, 6799)
LEFT_LOWER_LID = (
    6886, 6850, 6853, 6856, 6837, 11695, 6834, 6831, 6828, 6825, 6820, 6817, 6814, 6808
)  # fmt: skip


_SIDES = ("Left", "Right")


class Builder:
    """Makes heads from MakeHuman's data."""

    def __init__(self, source: MakeHuman) -> None:
        self._source = source
        self._mesh = mesh = source.base_mesh()
        self._plain = self._shaped(*REFERENCE)
        middle = self._plain[mesh.quads].mean(axis=1)
        body = mesh.group("body")
        is_socket = np.isin(mesh.quads, eye_sockets(mesh)).all(axis=1) & (middle[:, 2] < 1.1)
        neck = middle[:, 1] > np.maximum(4.2 - 0.3 * middle[:, 2], 4.0)  # well below the neckline
        self._face = mesh.quads[body & neck & ~is_socket]
        self._torso = mesh.quads[body & (middle[:, 1] > LOWEST) & (abs(middle[:, 0]) < 2.8)]
        self._tongue = subdivided(self._plain, mesh.quads[mesh.group("helper-tongue")])
        self._layout = subdivided(self._plain, self._face).vertices
        self._cavity = mouth_cavity(mesh, subdivided(self._plain, self._face))
        self.reference = self._skin(self._plain)
        self._map = self._face_map()

    def _shaped(self, targets: Shape, face_units: Shape) -> Float:
        """Shape the mesh (19158, 3), and move its pivot to the common place."""
        vertices = self._mesh.vertices.copy()
        for name, amount in targets:
            vertices += amount * self._source.target(name)
        for name, amount in face_units:
            vertices += amount * self._source.face_unit(name)
        joint = np.unique(self._mesh.quads[self._mesh.group("joint-head")])
        return np.asarray(vertices - vertices[joint].mean(axis=0) + PIVOT)

    def _skin(self, vertices: Float) -> Skin:
        skin = subdivided(vertices, self._face)
        x, y, z = self._layout.T
        top = np.clip((y - 6.48) / 0.15, 0, 1)
        normals = subdivision.vertex_normals(skin.vertices, subdivision.triangles_of(skin.quads))
        # keep the mouth's lining away from its corners
        corner = np.clip((np.abs(x) - 0.13) / 0.05, 0, 1) * (z > 1.0) * self._cavity
        skin.vertices[:] -= 0.05 * top[:, None] * normals + 0.012 * corner[:, None] * [0, 0, 1]
        close_lips(skin)
        return skin

    def build(self, person: Person, output: Path) -> None:
        """Make a head and write it to ``output``."""
        vertices = self._shaped(person.targets, person.face_units)
        skin = self._skin(vertices)
        fapu = measure_fapu(skin, vertices, self._mesh)
        blink, squint = (
            [self.reference.carry(self._source.face_unit(unit + side)) for side in _SIDES]
            for unit in ("eyeBlink", "eyeSquint")
        )
        face = FaceFields(self.reference, self._cavity, blink, squint, fapu).fields
        pieces = [
            self._skin_piece(skin, person, face),
            self._garment(vertices),
            *eye_pieces(vertices, self._mesh, fapu),
            *self._mouth_pieces(skin, fapu, person.raised),
            *self._hair(skin, person),
            self._lashes(skin, face, person.lashes),
        ]
        shade(pieces, self.reference.vertices, self._cavity, person.hair)
        output.parent.mkdir(parents=True, exist_ok=True)
        write(output, pieces, self._textures(person), skin, self._tongue, fapu, cel=person.look.cel)

    def _skin_piece(self, skin: Skin, person: Person, fields: Fields) -> HeadPiece:
        layout = self.reference.vertices
        covered = person.hair.hidden(layout) & ~self._cavity
        covered |= layout[:, 1] < neckline_height(layout[:, 2]) - 0.15

        def visible(quads: Index) -> Index:
            triangles = subdivision.triangles_of(quads)
            return triangles[~covered[triangles].all(axis=1)]

        part = parts.Geometry(
            skin.vertices, visible(skin.quads), paint.skin_uv(layout), np.ones_like(layout)
        )
        return HeadPiece(
            "skin",
            part,
            "skin",
            0.55,
            skin.matrix @ head_weight(self._source)[skin.base],
            fields,
            coarse_vertices=len(skin.base),
            coarse_triangles=visible(skin.coarse_quads),
        )

    def _garment(self, vertices: Float) -> HeadPiece:
        """Make a round-necked top: the torso, slightly enlarged, cut off around the neck."""
        torso, plain = (subdivided(shape, self._torso) for shape in (vertices, self._plain))
        smooth, layout = (skin.vertices[: len(skin.base)] for skin in (torso, plain))
        triangles = subdivision.triangles_of(torso.coarse_quads)
        normals = subdivision.vertex_normals(smooth, triangles)
        height = layout[:, 1] - neckline_height(layout[:, 2])
        cut, triangles, rim = subdivision.clip(height, triangles, np.hstack([smooth, normals]))
        points, normals = cut[:, :3], cut[:, 3:]
        # fold the edge toward the neck
        ring, local = np.unique(rim, return_inverse=True)
        local = local.reshape(rim.shape)
        folds = [points[ring] + out * normals[ring] + [0, up, 0] for out, up in _NECKBAND]
        strips = []
        previous = rim
        for step in range(len(folds)):
            following = local + len(points) + step * len(ring)
            strips += [
                np.stack([previous[:, 1], previous[:, 0], following[:, 0]], axis=1),
                np.stack([previous[:, 1], following[:, 0], following[:, 1]], axis=1),
            ]
            previous = following
        everything = np.concatenate([points + 0.034 * normals, *folds])
        used, compact = np.unique(np.concatenate([triangles, *strips]), return_inverse=True)
        everything = everything[used]
        part = parts.Geometry(
            everything,
            compact.reshape(-1, 3),
            np.full((len(everything), 2), 0.5),
            np.ones_like(everything),
        )
        return HeadPiece("garment", part, "cloth", 0.9, np.zeros(len(everything)))

    def _mouth_pieces(self, skin: Skin, fapu: dict[str, float], raised: float) -> list[HeadPiece]:
        lips = ("2.2", "2.3")
        middle, target = (
            one.vertices[one.points(*lips)].mean(axis=0) for one in (self.reference, skin)
        )
        corners = self.reference.points("8.3", "8.4")
        size = np.ptp(skin.vertices[corners, 0]) / np.ptp(self.reference.vertices[corners, 0])
        pieces = [*teeth_pieces(fapu), tongue_piece(self._tongue, fapu)]
        for piece in pieces:
            piece.part.vertices = (piece.part.vertices - middle) * size + target
            if piece.name != "teeth_upper":
                piece.part.vertices[:, 1] += raised
        return pieces

    def _hair(self, skin: Skin, person: Person) -> list[HeadPiece]:
        layout = self.reference.vertices
        outer = np.flatnonzero((layout[:, 1] > 4.7) & ~self._cavity)[::5]
        warp = interpolate.RBFInterpolator(
            layout[outer], skin.vertices[outer] - layout[outer], neighbors=60, smoothing=1e-3,
            kernel="linear",
        )  # fmt: skip
        pieces = []
        for name, part in person.hair.parts(layout).items():
            part.vertices = part.vertices + warp(part.vertices)
            count = len(part.vertices)
            # long locks need all their rows
            is_short = name == "hair_tips" and isinstance(person.hair, Crop)
            coarse = coarse_locks(count) if is_short else None
            pieces.append(
                HeadPiece(name, part, "hair", 0.7, np.ones(count), coarse_triangles=coarse)
            )
        return pieces

    def _lashes(self, skin: Skin, fields: Fields, length: float) -> HeadPiece:
        """Make two ribbons of lashes along the edges of the upper eyelids."""
        columns, rows = 25, 4
        layout = self.reference.vertices[: len(skin.base)]
        ribbons: list[parts.Geometry] = []
        shifts: dict[int, list[Float]] = {fap: [] for fap in fields}
        for side in (1.0, -1.0):
            lid = skin.number[np.array(LEFT_LID)]
            if side < 0:
                mirror = layout[lid] * [-1, 1, 1]
                lid = np.array([np.argmin(((layout - p) ** 2).sum(1)) for p in mirror])
            edge = skin.vertices[lid]
            length_along = np.concatenate(
                [[0], np.cumsum(np.linalg.norm(np.diff(edge, axis=0), axis=1))]
            )
            at = np.linspace(0.06, 1.0, columns) * length_along[-1]
            root = interpolate.make_interp_spline(length_along, edge, 3)(at)
            sideways = (np.linspace(-0.55, 1.0, columns) * side)[:, None] * [1.0, 0, 0]
            out = np.array([0.0, 0.0, 1.0]) + 0.75 * sideways
            grow = np.sin(np.pi * np.linspace(0.12, 0.80, columns))[:, None] * 0.060 * length
            points = np.concatenate([
                root
                + grow * (t * out * 0.85 + np.array([0.0, 1.0, 0.0]) * (0.75 * t**2 - 0.10 * t))
                for t in np.linspace(0, 1, rows)
            ])  # fmt: skip
            u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(1, 0, rows))
            uv = np.stack([u.ravel(), v.ravel()], axis=1)
            triangles = parts.grid_triangles(rows, columns)
            ribbons.append(parts.Geometry(points, triangles, uv, np.ones_like(points)))
            for fap, shift in fields.items():
                moved = np.zeros((columns, 3))
                if np.abs(shift[lid]).max() > 1e-6:
                    moved = interpolate.make_interp_spline(length_along, shift[lid], 3)(at)
                shifts[fap].append(np.tile(moved, (rows, 1)))
        both = {fap: np.concatenate(halves) for fap, halves in shifts.items() if np.any(halves)}
        part = join(ribbons)
        return HeadPiece("lashes", part, "lashes", 0.9, np.ones(len(part.vertices)), both)

    def _face_map(self) -> paint.FaceMap:
        skin = self.reference
        uv = paint.skin_uv(skin.vertices)
        normals = subdivision.vertex_normals(skin.vertices, subdivision.triangles_of(skin.quads))
        outward = skin.vertices - [0, 0, paint.AXIS_Z]
        outward[:, 1] = 0
        outer = ((normals * outward).sum(axis=1) > 0) & (skin.vertices[:, 0] > -1e-6)
        outer &= ~self._cavity
        return paint.face_map(skin.vertices[outer], uv[outer])

    def _textures(self, person: Person) -> dict[str, bytes]:
        look, plain = person.look, self._plain
        brow = plain[[FEATURE_POINTS[name] for name in ("4.1", "4.3", "4.5")]][:, :2]
        upper, lower = (plain[np.array(edge)] for edge in (LEFT_LID, LEFT_LOWER_LID))
        low = np.interp(upper[:, 0], lower[:, 0], lower[:, 1])
        lid = np.stack([upper[:, 0], upper[:, 1], low], axis=1)
        lips = lip_outline(self.reference)
        return {
            "skin": encode(paint.skin(self._map, brow, lid, lips, look, person.hair)),
            "eye": encode(paint_parts.eye(look.iris, look.iris_size)),
            "teeth_upper": encode(paint_parts.teeth(parts.UPPER_TEETH)),
            "teeth_lower": encode(paint_parts.teeth(parts.LOWER_TEETH)),
            "tongue": encode(paint_parts.tongue()),
            "cloth": encode(paint_parts.cloth(look.cloth)),
            "hair": encode(paint_parts.hair(look.hair)),
            "lashes": encode(paint_parts.lashes()),
        }
