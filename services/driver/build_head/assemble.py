"""Put the head together and write the asset."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate

from services.driver.build_head import paint, parts, surface
from services.driver.build_head.feature_points import FEATURE_POINTS
from services.driver.build_head.makehuman import METRES_PER_UNIT, BaseMesh, MakeHuman
from services.driver.build_head.occlusion import openness
from services.driver.build_head.zones import (
    FaceFields,
    Fields,
    Skin,
    close_lips,
    jaw_fields,
    subdivided,
    tongue_fields,
)
from services.driver.head import FORMAT

Float = NDArray[np.float64]
Index = NDArray[np.int64]

SHAPE = (
    ("macrodetails/asian-female-young", 1.0),
    ("head/head-oval", 0.35),
    ("chin/chin-width-decr", 0.25),
    ("nose/nose-scale-horiz-decr", 0.25),
    ("mouth/mouth-upperlip-height-decr", 0.35),
    ("mouth/mouth-lowerlip-height-decr", 0.40),
    ("eyes/l-eye-height2-incr", 0.55),
    ("eyes/r-eye-height2-incr", 0.55),
    ("eyes/l-eye-scale-incr", 0.20),
    ("eyes/r-eye-scale-incr", 0.20),
    ("ears/l-ear-wing-decr", 0.80),
    ("ears/r-ear-wing-decr", 0.80),
    ("ears/l-ear-scale-decr", 0.40),
    ("ears/r-ear-scale-decr", 0.40),
    ("ears/l-ear-lobe-decr", 0.60),
    ("ears/r-ear-lobe-decr", 0.60),
)
# the lips closed, which the plain target leaves apart, and a friendly look
FACE_SHAPE = (
    ("mouthPressLeft", 0.12),
    ("mouthPressRight", 0.12),
    ("mouthRollLower", 0.10),
    ("mouthSmileLeft", 0.06),
    ("mouthSmileRight", 0.06),
)
PIVOT = np.array([0.0, 5.472, 0.417])  # MakeHuman's joint-head: the top of the spine
LOWEST = 3.4  # dm, where the bust ends
# the front edge of the left upper eyelid, from the nose outwards
LEFT_LID = (6886, 6844, 6841, 6838, 6785, 6784, 6790, 6793, 6796, 6799)
LEFT_LOWER_LID = (
    6886, 6850, 6853, 6856, 6837, 11695, 6834, 6831, 6828, 6825, 6820, 6817, 6814, 6808
)  # fmt: skip
# the left half of the lips' outline, from 8.1 over 8.3 to 8.2
LIP_OUTLINE = (
    455, 7214, 7210, 7215, 7169, 11956, 7170, 7171, 7168, 7167, 10405, 7162, 7163, 10370, 7164,
    7165, 7166, 7235, 7241, 492,
)  # fmt: skip
_TORSO = ("spine", "clavicle", "shoulder", "upperarm", "breast", "root", "pelvis")


@dataclass(slots=True)
class Piece:
    """A part with what the asset stores beside its shape."""

    name: str
    part: parts.Part
    texture: str
    roughness: float
    head_weight: Float  # (V,)
    fields: Fields = field(default_factory=dict)  # FAP -> (V, 3), dm at 1 FAPU or 1 rad
    coarse_vertices: int = 0  # so many vertices make the coarse part; 0: there is one level
    coarse_triangles: Index | None = None


def build(source: MakeHuman, output: Path) -> None:
    """Make the head and write it to ``output``."""
    mesh = source.base_mesh()
    vertices = mesh.vertices.copy()
    for name, amount in SHAPE:
        vertices += amount * source.target(name)
    for name, amount in FACE_SHAPE:
        vertices += amount * source.face_unit(name)

    body = mesh.group("body")
    middle = vertices[mesh.quads].mean(axis=1)
    is_socket = np.isin(mesh.quads, _socket(mesh)).all(axis=1)
    neckline = middle[:, 1] - _neckline(middle[:, 2])
    kept = body & (neckline > -0.3) & (middle[:, 1] > 4.0) & ~(is_socket & (middle[:, 2] < 1.1))
    skin = subdivided(vertices, mesh.quads[kept])
    tongue = subdivided(vertices, mesh.quads[mesh.group("helper-tongue")])

    cavity = _cavity(mesh, skin)
    _make_room(skin, cavity)
    close_lips(skin)
    fapu = _fapu(skin, vertices, mesh)
    weight = _head_weight(source)
    face = _face_fields(source, skin, cavity, fapu)
    pieces = [
        _skin_piece(skin, weight, face),
        _garment(mesh, vertices, body & (middle[:, 1] > LOWEST) & (abs(middle[:, 0]) < 2.6)),
        *_eyes(vertices, mesh, fapu),
        *_teeth(fapu),
        _tongue_piece(tongue, fapu),
        *_hair(),
        _lashes(skin, face),
    ]
    _shade(pieces, cavity)
    textures = _textures(skin, vertices, cavity)
    output.parent.mkdir(parents=True, exist_ok=True)
    _write(output, pieces, textures, skin, tongue, fapu)


def _eye_centres(vertices: Float, mesh: BaseMesh) -> Float:
    """Centres of the left and the right eyeball (2, 3)."""
    centres = []
    for group in ("helper-l-eye", "helper-r-eye"):
        around = vertices[np.unique(mesh.quads[mesh.group(group)])]
        centres.append((around.max(axis=0) + around.min(axis=0)) / 2)
    return np.array(centres)


def _eye_radius(vertices: Float, mesh: BaseMesh) -> float:
    """Radius of an eyeball that stays behind the eyelids, dm."""
    around = vertices[np.unique(mesh.quads[mesh.group("helper-l-eye")])]
    return 0.988 * float(np.ptp(around[:, 0])) / 2


def _fapu(skin: Skin, vertices: Float, mesh: BaseMesh) -> dict[str, float]:
    """Measure the face in the units of the standard, in dm."""

    def at(name: str) -> Float:
        place: Float = skin.vertices[skin.point(name)]
        return place

    left, right = _eye_centres(vertices, mesh)
    return {
        "MNS": at("9.15")[1] - at("2.2")[1],
        "MW": at("8.3")[0] - at("8.4")[0],
        "ENS": left[1] - at("9.15")[1],
        "ES": left[0] - right[0],
        "IRISD": at("3.1")[1] - at("3.3")[1],
    }


def _cavity(mesh: BaseMesh, skin: Skin) -> NDArray[np.bool_]:
    """Say which vertices line the mouth: they have a texture island of their own."""
    islands = mesh.uv[mesh.uv_quads].max(axis=1)
    lining = mesh.group("body") & (islands[:, 1] < 0.137) & (islands[:, 0] > 0.7)
    is_lining = np.zeros(len(mesh.vertices))
    is_lining[mesh.quads[lining]] = 1.0
    cavity: NDArray[np.bool_] = skin.matrix @ is_lining[skin.base] > 0.5
    return cavity


def _make_room(skin: Skin, cavity: NDArray[np.bool_]) -> None:
    """Move the scalp away from the hair, and the mouth's lining away from its corners."""
    x, y, z = skin.vertices.T
    top = np.clip((y - 6.48) / 0.15, 0, 1)
    normals = surface.vertex_normals(skin.vertices, surface.triangles_of(skin.quads))
    corner = np.clip((np.abs(x) - 0.13) / 0.05, 0, 1) * (z > 1.0) * cavity
    skin.vertices[:] -= 0.05 * top[:, None] * normals + 0.012 * corner[:, None] * [0, 0, 1]


def _face_fields(
    source: MakeHuman, skin: Skin, cavity: NDArray[np.bool_], fapu: dict[str, float]
) -> Fields:
    """Fields of the skin."""
    blink, squint = (
        (skin.carry(source.face_unit(unit + "Left")), skin.carry(source.face_unit(unit + "Right")))
        for unit in ("eyeBlink", "eyeSquint")
    )
    return FaceFields(skin, cavity, blink, squint, fapu).fields


def _socket(mesh: BaseMesh) -> Index:
    """Vertices of the two bags behind the eyelids, which have texture islands of their own."""
    islands = mesh.uv_quads[mesh.group("body")]
    inside = (mesh.uv[islands].max(axis=(1, 2)) < 0.64) & (mesh.uv[islands][..., 0].max(1) < 0.152)
    return np.unique(mesh.quads[mesh.group("body")][inside])


def _neckline(z: Float) -> Float:
    """Height of the garment's edge round the neck."""
    return 4.50 - 0.30 * z


def _head_weight(source: MakeHuman) -> Float:
    """Share of the head's turn for every vertex of the base mesh: it fades down the neck."""
    weight = np.ones(19158)
    for bone, share in (("neck03", 0.25), ("neck02", 0.55), ("neck01", 0.85)):
        weight -= share * source.bone_weights(bone)
    for bone in source.bones():
        if bone.startswith(_TORSO):
            weight -= source.bone_weights(bone)
    np.clip(weight, 0, 1, out=weight)
    return weight


def _skin_piece(skin: Skin, weight: Float, fields: Fields) -> Piece:
    _, y, z = skin.vertices.T
    covered = (y > 6.56) | ((z < 0.0) & (y > 5.25)) | (y < _neckline(z) - 0.15)

    def seen(quads: Index) -> Index:
        triangles = surface.triangles_of(quads)
        shown: Index = triangles[~covered[triangles].all(axis=1)]
        return shown

    part = parts.Part(
        skin.vertices,
        seen(skin.quads),
        paint.skin_uv(skin.vertices),
        np.ones_like(skin.vertices),
    )
    return Piece(
        "skin",
        part,
        "skin",
        0.55,
        skin.matrix @ weight[skin.base],
        fields,
        coarse_vertices=len(skin.base),
        coarse_triangles=seen(skin.coarse_quads),
    )


def _garment(mesh: BaseMesh, vertices: Float, kept: NDArray[np.bool_]) -> Piece:
    """Make a round-necked top: the torso, a little larger, cut off round the neck."""
    torso = subdivided(vertices, mesh.quads[kept])
    triangles = surface.triangles_of(torso.quads)
    normals = surface.vertex_normals(torso.vertices, triangles)
    height = torso.vertices[:, 1] - _neckline(torso.vertices[:, 2])
    cut, triangles, rim = surface.clip(height, triangles, np.hstack([torso.vertices, normals]))
    points, normals = cut[:, :3], cut[:, 3:]
    # the edge is folded in towards the neck
    ring, local = np.unique(rim, return_inverse=True)
    local = local.reshape(rim.shape)
    folds = [
        points[ring] + out * normals[ring] + [0, up, 0]
        for out, up in ((0.034, 0.012), (0.020, 0.014), (0.002, -0.03))
    ]
    strips = []
    before = rim
    for step in range(len(folds)):
        after = local + len(points) + step * len(ring)
        strips += [
            np.stack([before[:, 1], before[:, 0], after[:, 0]], axis=1),
            np.stack([before[:, 1], after[:, 0], after[:, 1]], axis=1),
        ]
        before = after
    everything = np.concatenate([points + 0.034 * normals, *folds])
    used, compact = np.unique(np.concatenate([triangles, *strips]), return_inverse=True)
    everything = everything[used]
    part = parts.Part(
        everything,
        compact.reshape(-1, 3),
        np.full((len(everything), 2), 0.5),
        np.ones_like(everything),
    )
    return Piece("garment", part, "cloth", 0.9, np.zeros(len(everything)))


def _eyes(vertices: Float, mesh: BaseMesh, fapu: dict[str, float]) -> list[Piece]:
    pieces = []
    for row, name in enumerate(("eye_left", "eye_right")):
        centre = _eye_centres(vertices, mesh)[row]
        part = parts.eyeball(centre, _eye_radius(vertices, mesh))
        count = len(part.vertices)
        fields = {
            27 + row: np.tile([0.0, 0.0, fapu["ES"]], (count, 1)),
            29 + row: parts.pupil_growth(part, centre) * fapu["IRISD"] / 2,
        }
        pieces.append(Piece(name, part, "eye", 0.12, np.ones(count), fields))
    return pieces


def _teeth(fapu: dict[str, float]) -> list[Piece]:
    pieces = []
    for name, widths, edge, front, up in (
        ("teeth_upper", parts.UPPER_TEETH, 5.158, 1.222, 1.0),
        ("teeth_lower", parts.LOWER_TEETH, 5.162, 1.188, -1.0),
    ):
        part = parts.tooth_row(widths, edge, front, up)
        still = np.ones(len(part.vertices))
        fields = jaw_fields(part.vertices, still, fapu) if up < 0 else {}
        pieces.append(Piece(name, part, name, 0.35, still, fields))
    return pieces


def _tongue_piece(tongue: Skin, fapu: dict[str, float]) -> Piece:
    points = tongue.vertices * [1.2, 1.0, 1.0] + [0.0, -0.045, -0.03]
    uv = np.clip(points[:, [0, 2]] * [1.2, 0.8] + [0.5, -0.3], 0, 1)
    tint = np.clip((points[:, 2] - 0.55) / 0.6, 0.15, 1.0)[:, None] * [0.85, 0.7, 0.7]
    part = parts.Part(points, surface.triangles_of(tongue.quads), uv, tint)
    return Piece(
        "tongue",
        part,
        "tongue",
        0.4,
        np.ones(len(points)),
        tongue_fields(tongue, fapu),
        coarse_vertices=len(tongue.base),
        coarse_triangles=surface.triangles_of(tongue.coarse_quads),
    )


def _hair() -> list[Piece]:
    """Make the opaque body of the hair, and its thin front edge and tips."""
    pieces = []
    for name, rise, tips in (("hair", 0.0, False), ("hair_tips", 0.005, True)):
        sheets = [parts.hair_sheet(side, rise, 38, 34) for side in (1.0, -1.0)]
        count = len(sheets[0].vertices)
        triangles = np.concatenate([sheets[0].triangles, sheets[1].triangles + count])
        uv = np.concatenate([sheet.uv for sheet in sheets])
        u, v = uv[triangles, 0], uv[triangles, 1]
        shown = (
            (u.min(axis=1) < 0.16) | (v.max(axis=1) > 0.80)
            if tips
            else (u.min(axis=1) > 0.06) & (v.max(axis=1) < 0.90)
        )
        used, triangles = np.unique(triangles[shown], return_inverse=True)
        vertices = np.concatenate([sheet.vertices for sheet in sheets])[used]
        part = parts.Part(vertices, triangles.reshape(-1, 3), uv[used], np.ones_like(vertices))
        pieces.append(Piece(name, part, "hair", 0.5, np.ones(len(vertices))))
    return pieces


def _lashes(skin: Skin, fields: Fields) -> Piece:
    """Grow two ribbons of lashes out of the edges of the upper eyelids."""
    columns, rows = 25, 4
    pieces = []
    moved: list[Fields] = []
    for side in (1.0, -1.0):
        lid = skin.number[np.array(LEFT_LID)]
        if side < 0:
            mirror = skin.vertices[lid] * [-1, 1, 1]
            lid = np.array(
                [np.argmin(((skin.vertices[: len(skin.base)] - p) ** 2).sum(1)) for p in mirror]
            )
        edge = skin.vertices[lid]
        walked = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(edge, axis=0), axis=1))])
        at = np.linspace(0.06, 1.0, columns) * walked[-1]
        root = interpolate.make_interp_spline(walked, edge, 3)(at)
        sideways = (np.linspace(-0.55, 1.0, columns) * side)[:, None] * [1.0, 0, 0]
        out = np.array([0.0, 0.0, 1.0]) + 0.75 * sideways
        grow = np.sin(np.pi * np.linspace(0.12, 0.80, columns))[:, None] * 0.075
        ribbon = [
            root + grow * (t * out * 0.85 + np.array([0.0, 1.0, 0.0]) * (0.75 * t**2 - 0.10 * t))
            for t in np.linspace(0, 1, rows)
        ]
        points = np.concatenate(ribbon)
        uv = np.stack(
            [
                np.tile(np.linspace(0, 1, columns), rows),
                np.repeat(np.linspace(1, 0, rows), columns),
            ],
            axis=1,
        )
        triangles = parts.grid_triangles(rows, columns)
        pieces.append(parts.Part(points, triangles, uv, np.ones_like(points)))
        moved.append(
            {
                fap: np.tile(interpolate.make_interp_spline(walked, shift[lid], 3)(at), (rows, 1))
                for fap, shift in fields.items()
                if np.abs(shift[lid]).max() > 1e-6
            }
        )
    left, right = pieces
    count = len(left.vertices)
    part = parts.Part(
        np.concatenate([left.vertices, right.vertices]),
        np.concatenate([left.triangles, right.triangles + count]),
        np.concatenate([left.uv, right.uv]),
        np.ones((2 * count, 3)),
    )
    both: Fields = {}
    for half, own in enumerate(moved):
        for fap, shift in own.items():
            whole = both.setdefault(fap, np.zeros((2 * count, 3)))
            whole[half * count : (half + 1) * count] = shift
    return Piece("lashes", part, "lashes", 0.9, np.ones(2 * count), both)


# an open mouth and drooping lids, with which the occlusion of lips, teeth and lids is judged
_OPEN = {
    3: 300, 4: -200, 8: -180, 9: -180, 5: -400, 10: -360, 11: -360, 51: -180, 55: -160, 56: -160,
    52: -360, 57: -320, 58: -320, 19: 650, 20: 650,
}  # fmt: skip


def _opened(piece: Piece) -> Float:
    vertices = piece.part.vertices.copy()
    for fap, value in _OPEN.items():
        if fap in piece.fields:
            vertices += piece.fields[fap] * (value / 1024)
    return vertices


def _shade(pieces: list[Piece], cavity: NDArray[np.bool_]) -> None:
    """Bake the ambient occlusion into the vertex colours."""
    solid = [p for p in pieces if p.name != "lashes"]
    offsets = np.cumsum([0] + [len(p.part.vertices) for p in solid])
    vertices = np.concatenate([_opened(p) for p in solid])
    normals = np.concatenate([surface.vertex_normals(_opened(p), p.part.triangles) for p in solid])

    def unhidden(with_hair: bool) -> Float:
        triangles = [
            p.part.triangles + first
            for p, first in zip(solid, offsets, strict=False)
            if with_hair or not p.name.startswith("hair")
        ]
        return openness(vertices, normals, np.concatenate(triangles))

    # the hair is thin where it meets the face: there it would cast jagged shadows
    seen, seen_with_hair = unhidden(False), unhidden(True)
    for piece, first in zip(solid, offsets, strict=False):
        part = piece.part
        rows = slice(first, first + len(part.vertices))
        under_hair = np.clip((0.66 - part.vertices[:, 2]) / 0.12, 0, 1)  # ears, sides of the neck
        if piece.name.startswith("hair"):
            under_hair[:] = 1
        own = (1 - under_hair) * seen[rows] + under_hair * seen_with_hair[rows]
        own = np.clip(own, 0, 1)[:, None]
        if piece.name == "skin":
            shade = np.clip(0.10 + 1.0 * own, 0, 1) ** np.array([0.75, 1.0, 1.1])
            # the ears lie in the hair's shadow, deeper than the sparse vertices tell
            shade *= 1 - 0.6 * np.clip((np.abs(part.vertices[:, :1]) - 0.645) / 0.04, 0, 1)
            depth = np.clip((part.vertices[:, 2:] - 0.85) / 0.42, 0, 1)
            lining = np.array([0.62, 0.20, 0.19]) * (0.10 + 0.90 * depth)
            part.colors = np.where(cavity[:, None], lining * (0.7 + 0.3 * shade), shade)
        elif piece.name == "garment":
            part.colors = np.repeat(0.6 + 0.4 * own, 3, axis=1)
        elif piece.name.startswith("eye"):
            lit = np.clip(
                0.95 - 2.2 * (part.vertices[:, 1:2] - part.vertices[0, 1] - 0.005) / 0.1, 0.45, 1.0
            )
            part.colors = np.repeat(lit, 3, axis=1)
        elif piece.name.startswith("hair"):
            part.colors = np.repeat(0.45 + 0.55 * own, 3, axis=1)
        elif piece.name.startswith("teeth"):
            part.colors = part.colors * (0.55 + 0.45 * np.clip(1.5 * own, 0, 1))


def _textures(skin: Skin, vertices: Float, cavity: NDArray[np.bool_]) -> dict[str, bytes]:
    uv = paint.skin_uv(skin.vertices)
    normals = surface.vertex_normals(skin.vertices, surface.triangles_of(skin.quads))
    outward = skin.vertices - [0, 0, paint.AXIS_Z]
    outward[:, 1] = 0
    outer = ((normals * outward).sum(axis=1) > 0) & (skin.vertices[:, 0] > -1e-6) & ~cavity
    face = paint.face_map(skin.vertices[outer], uv[outer])
    brow = vertices[[FEATURE_POINTS[name] for name in ("4.1", "4.3", "4.5")]][:, :2]
    upper, lower = (vertices[np.array(edge)] for edge in (LEFT_LID, LEFT_LOWER_LID))
    low = np.interp(upper[:, 0], lower[:, 0], lower[:, 1])
    lid = np.stack([upper[:, 0], upper[:, 1], low], axis=1)
    return {
        "skin": paint.encode(paint.skin(face, brow, lid, _lip_outline(skin))),
        "eye": paint.encode(paint.eye()),
        "teeth_upper": paint.encode(paint.teeth(parts.UPPER_TEETH)),
        "teeth_lower": paint.encode(paint.teeth(parts.LOWER_TEETH)),
        "tongue": paint.encode(paint.tongue()),
        "cloth": paint.encode(paint.cloth()),
        "hair": paint.encode(paint.hair()),
        "lashes": paint.encode(paint.lashes()),
    }


def _lip_outline(skin: Skin) -> Float:
    """Outlines of the lips (N, 3) from the middle outwards: x, upper and lower height, dm."""
    corner = LIP_OUTLINE.index(FEATURE_POINTS["8.3"])
    upper, lower = (
        skin.vertices[skin.number[np.array(half)]]
        for half in (LIP_OUTLINE[: corner + 1], LIP_OUTLINE[: corner - 1 : -1])
    )
    x = upper[:, 0]
    order = np.argsort(lower[:, 0])
    return np.stack([x, upper[:, 1], np.interp(x, lower[order, 0], lower[order, 1])], axis=1)


def _write(
    output: Path,
    pieces: list[Piece],
    textures: dict[str, bytes],
    skin: Skin,
    tongue: Skin,
    fapu: dict[str, float],
) -> None:
    def metres(points: Float) -> NDArray[np.float32]:
        return np.asarray((points - PIVOT) * METRES_PER_UNIT, dtype=np.float32)

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
        at_edge, at_root = parts.middle_of_teeth(piece.part)
        points |= {edge: start[piece.name] + at_edge, root: start[piece.name] + at_root}
    vertices = np.concatenate([p.part.vertices for p in pieces])
    fapu = {name: value * METRES_PER_UNIT for name, value in fapu.items()} | {"AU": 1e-5}

    faps, units, bounds, moved, shifts = [], [], [0], [], []
    for fap in sorted({fap for piece in pieces for fap in piece.fields}):
        for piece in pieces:
            if fap in piece.fields:
                shift = piece.fields[fap] * METRES_PER_UNIT
                rows = np.flatnonzero(np.abs(shift).max(axis=1) > 2e-6)
                moved.append(rows + start[piece.name])
                shifts.append(shift[rows])
        faps.append(fap)
        units.append(1e5 if fap == 47 else 1024.0)
        bounds.append(sum(len(rows) for rows in moved))
    centres = metres(np.stack([(e.vertices.max(0) + e.vertices.min(0)) / 2 for e in eyes]))
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "vertices": metres(vertices),
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
        "part_transparent": np.array([p.name in ("hair_tips", "lashes") for p in pieces]),
        "part_double_sided": np.array([p.texture in ("hair", "lashes") for p in pieces]),
        "part_vertices": np.array(part_vertices),
        "part_triangles": np.array(part_triangles),
        "fapu_names": np.array(list(fapu)),
        "fapu": np.array(list(fapu.values())),
        "feature_point_names": np.array(list(points)),
        "feature_points": np.array(list(points.values())),
        "eye_centres": centres,
        "field_faps": np.array(faps, dtype=np.int64),
        "field_units": np.array(units),
        "field_bounds": np.array(bounds),
        "field_vertices": np.concatenate([*moved, np.zeros(0, int)]).astype(np.uint16),
        "field_shifts": np.concatenate([*shifts, np.zeros((0, 3))]).astype(np.float16),
    }
    for name, data in textures.items():
        arrays[f"texture_{name}"] = np.frombuffer(data, np.uint8)
    np.savez_compressed(output, allow_pickle=False, **arrays)
