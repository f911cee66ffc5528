"""Converts a user's GLB or VRM to a head. Its shapes become the linear basis of the FAPs.

Shapes are recognized by name (``shared.face.shape_names``): FAPs, ARKit's blendshapes, Oculus'
visemes, or VRM's vowels; the last two also with ARKit's or VRM's shapes outside the mouth. A FAP
frame ``f`` is expressed by the shapes whose FAPs ``A`` are closest,

    w(f) = argmin |D (A^T w - f)|^2 + r^2 |w|^2 = (A D^2 A^T + r^2 I)^-1 A D^2 f

with ``D``, the travel of a FAP's feature point per unit. This is linear in ``f``, so the head has
one displacement field per FAP. FAPs without a shape are approximated by other shapes. Negative
weights are allowed; they move a shape's vertices in the opposite direction.

======  ============================================  ====  ========
symbol  meaning                                       unit  shape
======  ============================================  ====  ========
A       FAPs of each shape at weight 1                FAP   (N, 68)
D       travel by one FAP unit                        m     (68,)
r       ridge: keeps weights of similar shapes small  m     1
======  ============================================  ====  ========
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from kouxing.services.driver.head.glb_file import GlbFile, check_glb
from kouxing.services.driver.head.glb_pieces import find_bones, read_pieces
from kouxing.services.driver.head.head import Head, assemble_head
from kouxing.services.driver.head.mesh_pieces import FapFields, MeshPiece, pack_head, part_names
from kouxing.services.driver.head.morph_targets import units_per_weight
from kouxing.shared.arrays import Doubles
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import (
    FAP_NUMBER,
    FAP_UNITS_PER_FAPU,
    FAPS,
    NUM_FAPS,
    RADIANS_PER_ANGLE_UNIT,
)
from kouxing.shared.face.shape_names import choose_set, find_shapes
from kouxing.shared.face.shapes import ARKIT, OCULUS, VRM

EYE_DISTANCE_M = 0.055  # heads are scaled to this
RELATIVE_FAPU = {"MNS": 0.36, "MW": 0.83, "ENS": 0.86, "ES": 1.0, "IRISD": 0.16}  # eye distances
# offsets from the middle between the eyes, in eye distances
PIVOT_OFFSET = np.array([0.0, -0.66, -1.42])
MOUTH_OFFSET = np.array([0.0, -1.2, 0.25])
_HEAD_WIDTH = 2.9  # including ears, in eye distances
_EYE_RADIUS_M = 0.012
_RIDGE_M = 0.001
_TRAVEL_M = 0.01  # typical displacement of a feature point by a strong FAP
_NECK_HEIGHTS = (-2.1, -3.2)  # heights relative to the eyes where the neck stops following the head
_MIN_FAPS = 12
_MAX_FACES_APART = 2.0  # distance of the parts of one face, in sizes of a part
_MAX_TILT_RAD = 0.17  # angle between the eyes and the x axis that is not corrected
_MIN_STEEPNESS = 1.5  # how much farther the mouth is below the eyes along an axis that replaces y

_JAW_RAD = 0.3  # rotation of a jaw bone at a weight of 1 of ARKit's jawOpen
_JAW = FAP_NUMBER["open_jaw"] - 1
_OPEN_JAW = float(ARKIT.basis[ARKIT.names.index("jawOpen"), _JAW])
_GAZE_FAPS = (23, 24, 25, 26)
_FAP_BY_NAME = {fap.name: fap for fap in FAPS[2:]}
_NOT_MOUTH = re.compile("eye|brow|cheek|nose|blink|look")
_SETS = {"arkit": ARKIT, "oculus": OCULUS, "vrm": VRM}
ShapeFaps = dict[str, Doubles]  # shape: FAPs (68,) at weight 1


def read_glb(path: Path) -> Head:
    """Read a GLB or VRM whose shapes are FAPs, or ARKit's, Oculus' or VRM's.

    Raises ``UserError`` if the file is not such a GLB; the text says what is missing.
    """
    with check_glb(path), np.errstate(invalid="ignore", over="ignore"):  # the results are checked
        glb = GlbFile(path)
        pieces = read_pieces(glb)
        return _make_head(path.stem, glb, pieces, _select_known_shapes(pieces))


def _select_known_shapes(pieces: list[MeshPiece]) -> ShapeFaps:
    """Keep only known shapes in the pieces, under their standard names; return the shapes' FAPs.

    Raises ``UserError`` if the shapes cannot express speech.
    """
    names = dict.fromkeys(
        name for piece in pieces for name, shift in piece.shapes.items() if shift.any()
    )
    faps = {name: fap for name in names if (fap := re.split("[.:|]", name)[-1]) in _FAP_BY_NAME}
    if len(faps) < _MIN_FAPS or "open_jaw" not in faps.values():
        faps = {}  # other sets of shapes may share a few names
    table: ShapeFaps = {}
    if faps:
        for fap in _FAP_BY_NAME.values():
            table[fap.name] = np.zeros(NUM_FAPS)
            table[fap.name][fap.number - 1] = units_per_weight(fap.fapu)
    else:
        set_name = choose_set(names)
        for kind, standard in _SETS.items():
            for name, row in zip(standard.names, standard.basis, strict=True):
                is_wanted = set_name != "arkit" and _NOT_MOUTH.search(name)
                if row.any() and (kind == set_name or is_wanted):
                    table[name] = row.astype(float)
    for piece in pieces:
        shape_of = faps or {
            name: shape
            for kind in (*(other for other in reversed(_SETS) if other != set_name), set_name)
            for name, shape in find_shapes(kind, piece.shapes).items()
            if shape in table
        }
        _rename_known_shapes(piece, shape_of)
    known = {name for piece in pieces for name in piece.shapes}
    return {name: row for name, row in table.items() if name in known}


def _rename_known_shapes(piece: MeshPiece, shape_of: Mapping[str, str]) -> None:
    """Rename the known shapes of a piece, and apply the other shapes' weights at rest."""
    shapes, piece.shapes = piece.shapes, {}
    for name, shift in shapes.items():
        if name in shape_of:
            shape = shape_of[name]
            piece.shapes[shape] = piece.shapes.get(shape, 0.0) + shift
        elif name in piece.rest:
            piece.vertices = piece.vertices + piece.rest[name] * shift


def _turn_jaw(piece: MeshPiece, arm: Doubles, shape_faps: ShapeFaps) -> None:
    """Let a jaw bone move the teeth and the tongue, if they have no shapes that open the mouth."""
    opening = {name: row[_JAW] / _OPEN_JAW for name, row in shape_faps.items() if row[_JAW] > 0}
    if not opening.keys() & piece.shapes.keys():
        shift = _JAW_RAD * np.cross([1, 0, 0], arm)
        piece.shapes |= {name: weight * shift for name, weight in opening.items()}


# --- the head -------------------------------------------------------------------------------------


def _make_head(name: str, glb: GlbFile, pieces: list[MeshPiece], shape_faps: ShapeFaps) -> Head:
    names = part_names(pieces)
    _check_single_face(pieces, shape_faps)
    eyes = _find_eye_centers(glb, pieces, names)
    eye_distance = float(np.linalg.norm(eyes[0] - eyes[1]))
    if not 1e-6 < eye_distance < 1e6:
        raise UserError("both eyes, found by shapes or names, are in the same place")
    mouth = [name for name in shape_faps if not _NOT_MOUTH.search(name)]
    is_mirrored = any(piece.is_mirrored for piece in pieces if piece.shapes.keys() & mouth)
    rotation = _upright_rotation(eyes, _moved_center(pieces, mouth), is_mirrored=is_mirrored)
    for piece in pieces:
        if piece.is_mirrored != is_mirrored:
            piece.triangles = piece.triangles[:, ::-1]
        piece.vertices = piece.vertices @ rotation.T
        piece.shapes = {name: shift @ rotation.T for name, shift in piece.shapes.items()}
        if piece.jaw_arm is not None:
            _turn_jaw(piece, piece.jaw_arm @ rotation.T, shape_faps)
    eyes = eyes @ rotation.T
    scale, middle = EYE_DISTANCE_M / eye_distance, eyes.mean(axis=0)
    pivot = _find_pivot(glb, rotation, middle, eye_distance)
    world = np.concatenate([piece.vertices for piece in pieces])
    weights = [piece.head_weight for piece in pieces if piece.head_weight is not None]
    if len(weights) == len(pieces):  # every piece has a skeleton
        head_weight = np.concatenate(weights)
    else:
        head_weight = head_weight_at((world[:, 1] - middle[1]) / eye_distance)
    for piece in pieces:
        piece.vertices = (piece.vertices - pivot) * scale
        piece.shapes = {name: shift * scale for name, shift in piece.shapes.items()}
    has_eyes = any(name.startswith("eye_") for name in names)
    fap_weights = _weights_by_fap(shape_faps, with_gaze=not has_eyes)
    arrays = pack_head(
        pieces,
        fields=[_displacement_fields(piece, fap_weights) for piece in pieces],
        head_weight=head_weight,
        fapu=standard_fapu(),
        feature_points={},
        eye_centers=(eyes - pivot) * scale,
    )
    return assemble_head(name, arrays)


def standard_fapu() -> dict[str, float]:
    """Return the FAPUs of an average face, m and rad."""
    lengths = {name: relative * EYE_DISTANCE_M for name, relative in RELATIVE_FAPU.items()}
    return lengths | {"AU": RADIANS_PER_ANGLE_UNIT}


def head_weight_at(height: Doubles) -> Doubles:
    """Return the fraction (V,) of the head rotation by height above the eyes, in eye distances."""
    x = np.clip((height - _NECK_HEIGHTS[1]) / (_NECK_HEIGHTS[0] - _NECK_HEIGHTS[1]), 0, 1)
    return x**2 * (3 - 2 * x)


def _check_single_face(pieces: list[MeshPiece], shape_faps: ShapeFaps) -> None:
    """Raise ``UserError`` if two meshes far from each other have a mouth."""
    opener = next(name for name in ("open_jaw", "jawOpen", "aa") if name in shape_faps)
    centers: list[Doubles] = []
    size = 0.0
    for piece in pieces:
        moved = np.linalg.norm(piece.shapes.get(opener, np.zeros((1, 3))), axis=1)
        if moved.max() > 0:
            shown = piece.vertices[moved > 0.1 * moved.max()]
            centers.append(shown.mean(axis=0))
            size = max(size, float(np.linalg.norm(np.ptp(shown, axis=0))))
    if centers and np.linalg.norm(np.ptp(centers, axis=0)) > _MAX_FACES_APART * size > 0:
        raise UserError("it has several faces; export only one avatar")


def _upright_rotation(eyes: Doubles, mouth: Doubles | None, *, is_mirrored: bool) -> Doubles:
    """Return the rotation (3, 3) after which y is up and the face looks along z.

    It turns by right angles, and then by the remaining angle of the eyes if that is large. For a
    mirrored face, the result also contains a reflection, which undoes the mirroring.
    """
    side = eyes[0] - eyes[1]
    x = int(np.abs(side).argmax())
    y = 1 if x != 1 else 2
    sign = 1.0
    if mouth is not None:
        up = eyes.mean(axis=0) - mouth
        other = 3 - x - y
        if abs(up[other]) > _MIN_STEEPNESS * abs(up[y]):
            y = other
        sign = -1.0 if up[y] < 0 else 1.0
    rotation = np.zeros((3, 3))
    rotation[0, x], rotation[1, y] = np.sign(side[x]), sign
    rotation[2] = np.cross(rotation[0], rotation[1]) * (-1 if is_mirrored else 1)
    remaining, _ = Rotation.align_vectors([1, 0, 0], rotation @ side)
    if remaining.magnitude() > _MAX_TILT_RAD:
        rotation = remaining.as_matrix() @ rotation
    return rotation


def _find_eye_centers(glb: GlbFile, pieces: list[MeshPiece], names: list[str]) -> Doubles:
    """Find the centers of the left and right eye (2, 3) by bones, eyeballs or lids.

    If an eye has none of these, estimate both centers.
    """
    bones = {bone: number for number, bone in find_bones(glb).items()}
    matrices = dict(glb.nodes())
    centers = []
    for side in ("left", "right"):
        balls = [
            piece.vertices
            for piece, name in zip(pieces, names, strict=True)
            if name.startswith(f"eye_{side}")
        ]
        lids = _moved_center(pieces, [f"eyeBlink{side.title()}", f"blink{side.title()}"])
        if bones.get(f"{side}Eye") in matrices:
            centers.append(matrices[bones[f"{side}Eye"]][:3, 3])
        elif balls:
            eyeball = np.concatenate(balls)
            centers.append((eyeball.min(axis=0) + eyeball.max(axis=0)) / 2)
        elif lids is not None:
            centers.append(lids)
    return np.array(centers) if len(centers) == 2 else _estimate_eye_centers(glb, pieces)


def _estimate_eye_centers(glb: GlbFile, pieces: list[MeshPiece]) -> Doubles:
    """Estimate the eye centers (2, 3) from the width of the head and the position of the mouth."""
    mouth = _moved_center(pieces, [name for piece in pieces for name in piece.shapes])
    skin = max((piece for piece in pieces if piece.shapes), key=lambda piece: len(piece.vertices))
    if mouth is None:
        mouth = skin.vertices.mean(axis=0)
    near = np.abs(skin.vertices[:, 1] - mouth[1])
    width = np.ptp(skin.vertices[near < np.quantile(near, 0.5), 0])
    eye_distance = width / _HEAD_WIDTH
    middle = mouth - MOUTH_OFFSET * eye_distance
    half = np.array([eye_distance / 2, 0, 0])
    if "VRM" in glb.json.get("extensions", {}):  # version 0 looks along -z
        half = -half
    return np.stack([middle + half, middle - half])


def _moved_center(pieces: list[MeshPiece], names: list[str]) -> Doubles | None:
    """Return the mean position of the vertices that some shapes move."""
    total, center = 0.0, np.zeros(3)
    for piece in pieces:
        for name in set(names) & set(piece.shapes):
            size = np.linalg.norm(piece.shapes[name], axis=1)
            total += float(size.sum())
            center += size @ piece.vertices
    return center / total if total > 0 else None


def _find_pivot(glb: GlbFile, rotation: Doubles, middle: Doubles, eye_distance: float) -> Doubles:
    """Return the position of the joint that the head rotates about."""
    bones = find_bones(glb)
    for number, matrix in glb.nodes():
        position = rotation @ matrix[:3, 3]
        is_joint = bones.get(number) == "head" and "mesh" not in glb.item("nodes", number)
        if is_joint and np.linalg.norm(position - middle) < 4 * eye_distance:
            return position
    return middle + PIVOT_OFFSET * eye_distance


def _weights_by_fap(shape_faps: ShapeFaps, *, with_gaze: bool) -> dict[str, Doubles]:
    """Return each shape's weight per unit of every FAP (68,), by the module's equation."""
    names = sorted(shape_faps, key=str.lower)
    shapes = np.array([shape_faps[name] for name in names])
    if names[0] in _FAP_BY_NAME:
        return dict(zip(names, np.where(shapes > 0, 1 / np.maximum(shapes, 1), 0), strict=True))
    travel = _travel_m(with_gaze=with_gaze)
    matrix = shapes * travel
    gram = matrix @ matrix.T + _RIDGE_M**2 * np.eye(len(shapes))
    weights = np.linalg.solve(gram, matrix * travel)
    # a shape that moves less than 0.1 mm at 1 cm of travel is noise that would fill the basis
    weights[np.abs(weights) < 0.01 * travel / _TRAVEL_M] = 0
    return dict(zip(names, weights, strict=True))


def _displacement_fields(piece: MeshPiece, weights: dict[str, Doubles]) -> FapFields:
    """Return the displacements (V, 3) of a piece by one unit of each FAP, m."""
    names = [name for name in piece.shapes if name in weights]
    if not names:
        return {}
    shifts = np.array([piece.shapes[name] for name in names])
    table = np.array([weights[name] for name in names])  # (shapes, 68)
    return {
        int(number) + 1: np.tensordot(table[:, number], shifts, axes=1)
        for number in np.flatnonzero(np.abs(table).max(axis=0))
    }


def _travel_m(*, with_gaze: bool) -> Doubles:
    """Return the travel of a FAP's feature point per unit, m; 0 for FAPs to ignore."""
    fapu = standard_fapu()
    travel = np.zeros(NUM_FAPS)
    for fap in FAPS[2:]:
        if fap.fapu != "AU":
            travel[fap.number - 1] = fapu[fap.fapu] / FAP_UNITS_PER_FAPU
        elif fap.name == "tongue_roll" or (with_gaze and fap.number in _GAZE_FAPS):
            travel[fap.number - 1] = _EYE_RADIUS_M * RADIANS_PER_ANGLE_UNIT
    return travel
