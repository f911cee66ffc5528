"""A user's GLB as a head: its morph targets become the linear basis of FAPs.

Targets are known by their names: FAPs, ARKit's blend shapes, or Oculus' visemes (with ARKit's
shapes for what is not the mouth). For the last two, a FAP frame ``f`` is given to the shapes whose
FAPs ``A`` come nearest,

    w(f) = argmin |D (A^T w - f)|^2 + r^2 |w|^2 = (A D^2 A^T + r^2 I)^-1 A D^2 f

with the travel ``D`` of a FAP's feature point by one unit. That is linear in ``f``, so the head
has one displacement field a FAP like any other; what a file has no shape for, others express as
far as they can. Weights below 0, which move a shape's vertices the other way, are meant.

======  ========================================  ====  ========
symbol  meaning                                   unit  shape
======  ========================================  ====  ========
A       FAPs of each shape at weight 1            FAP   (N, 68)
D       travel by one FAP unit                    m     (68,)
r       keeps shapes that nearly agree small      m     1
======  ========================================  ====  ========
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from kouxing.services.driver.head.glb_file import BadGlbError, Float64, Glb
from kouxing.services.driver.head.glb_pieces import plain, read_pieces
from kouxing.services.driver.head.head import Head, assemble
from kouxing.services.driver.head.pieces import Fields, Piece, pack, part_names
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, NUM_FAPS, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.shapes import ARKIT, OCULUS

EYE_DISTANCE_M = 0.055  # to which a head is scaled
# the units of an average face, in eye distances
FAPU_SHARES = {"MNS": 0.36, "MW": 0.83, "ENS": 0.86, "ES": 1.0, "IRISD": 0.16}
PIVOT = np.array([0.0, -0.66, -1.42])  # from between the eyes to the head's pivot, in eye distances
MOUTH = np.array([0.0, -1.2, 0.25])  # likewise
_HEAD_WIDTH = 2.9  # likewise, ears included
_EYE_RADIUS_M = 0.012
_RIDGE_M = 0.001
_TRAVEL_M = 0.01  # how far a strong FAP moves its point
_FADE = (-2.1, -3.2)  # heights from the eyes between which the neck stops following the head
_MIN_ARKIT, _MIN_OCULUS, _MIN_FAPS = 12, 8, 12

_FAP_NAMES = {plain(fap.name): fap for fap in FAPS[2:]}
Names = dict[str, Float64]  # shape name as in a file: FAPs (68,) at weight 1


def read_glb(path: Path) -> Head:
    """Read a GLB whose morph targets are FAPs, ARKit shapes or Oculus visemes.

    Raises
    ------
    UserError
        If the file is no such GLB; the text says what it lacks.
    """
    try:
        glb = Glb(path)
        with np.errstate(invalid="ignore", over="ignore"):  # what comes out is checked
            pieces = read_pieces(glb)
            names = sorted({name for piece in pieces for name in piece.shapes})
            known = recognise(names)
            return _head(path.stem, glb, pieces, known)
    except BadGlbError as error:
        raise UserError(f"{path}: {error}") from error
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, OverflowError) as error:
        raise UserError(f"{path} is no intact GLB ({error!r})") from error


def recognise(names: list[str]) -> Names:
    """Find what the morph targets of a file stand for.

    Parameters
    ----------
    names
        As ``plain`` gives them.

    Returns
    -------
    FAPs (68,) of each known name at weight 1.

    Raises
    ------
    BadGlbError
        If too few are known.
    """
    faps: Names = {name: np.zeros(NUM_FAPS) for name in _FAP_NAMES}
    for name, fap in _FAP_NAMES.items():
        angle = fap.fapu == "AU"
        faps[name][fap.number - 1] = 1 / RADIANS_PER_ANGLE_UNIT if angle else FAP_UNITS_PER_FAPU
    arkit, oculus = (
        {plain(name): row.astype(float) for name, row in zip(each.names, each.basis, strict=True)}
        for each in (ARKIT, OCULUS)
    )
    oculus = {"viseme" + name: faps for name, faps in oculus.items() if faps.any()}
    # Ready Player Me writes the vowels so
    oculus |= {
        "viseme" + new: oculus["viseme" + old]
        for new, old in (("i", "ih"), ("o", "oh"), ("u", "ou"))
    }
    still = {name: row for name, row in arkit.items() if not re.match("jaw|mouth|tongue", name)}
    found = []
    for kind, least, table, rest in (
        ("FAPs", _MIN_FAPS, faps, {}),
        ("ARKit shapes", _MIN_ARKIT, arkit, {}),
        ("Oculus visemes", _MIN_OCULUS, oculus, still),
    ):
        known = [name for name in names if name in table]
        if len(known) >= least:
            return {name: (table | rest)[name] for name in names if name in table or name in rest}
        found.append(f"{len(known)} of at least {least} {kind}")
    seen = (
        f" Its targets: {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}." if names else ""
    )
    raise BadGlbError(
        f"its morph targets have too few known names ({'; '.join(found)}).{seen}"
        " Name them as ARKit (jawOpen, mouthPucker, ...) or Oculus (viseme_aa, viseme_PP, ...) does"
    )


# --- the head -------------------------------------------------------------------------------------


def _head(name: str, glb: Glb, pieces: list[Piece], known: Names) -> Head:
    names = part_names(pieces)
    for piece in pieces:
        piece.shapes = {name: shift for name, shift in piece.shapes.items() if name in known}
    eyes = _eyes(pieces, names)
    if eyes[0, 0] < eyes[1, 0]:  # it looks along -z, as VRM 0 does
        for piece in pieces:
            piece.vertices *= [-1, 1, -1]
            piece.shapes = {name: shift * [-1, 1, -1] for name, shift in piece.shapes.items()}
        eyes *= [-1, 1, -1]
    unit = float(np.linalg.norm(eyes[0] - eyes[1]))
    if not 1e-6 < unit < 1e6:
        raise BadGlbError("its eyes, by their shapes or names, lie in one place")
    if eyes[0, 0] - eyes[1, 0] < 0.5 * unit:
        raise BadGlbError("its eyes do not lie side by side; let y be up and the face look along z")
    scale, middle = EYE_DISTANCE_M / unit, eyes.mean(axis=0)
    pivot = _pivot(glb, middle, unit)
    world = np.concatenate([piece.vertices for piece in pieces])
    weight = _head_weight(pieces, (world[:, 1] - middle[1]) / unit)
    for piece in pieces:
        piece.vertices = (piece.vertices - pivot) * scale
        piece.shapes = {name: shift * scale for name, shift in piece.shapes.items()}
    has_eyes = any(name.startswith("eye_") for name in names)
    weights = _weights_by_fap(known, gaze=not has_eyes)
    arrays = pack(
        pieces,
        fields=[_fields(piece, weights) for piece in pieces],
        head_weight=weight,
        fapu=standard_fapu(),
        feature_points={},
        eye_centres=(eyes - pivot) * scale,
    )
    return assemble(name, arrays)


def standard_fapu() -> dict[str, float]:
    """FAPUs of an average face, in m and rad."""
    lengths = {name: share * EYE_DISTANCE_M for name, share in FAPU_SHARES.items()}
    return lengths | {"AU": RADIANS_PER_ANGLE_UNIT}


def fade(height: Float64) -> Float64:
    """Share of the head's turn (V,) by the height over the eyes in eye distances."""
    share = np.clip((height - _FADE[1]) / (_FADE[0] - _FADE[1]), 0, 1)
    faded: Float64 = share**2 * (3 - 2 * share)
    return faded


def _eyes(pieces: list[Piece], names: list[str]) -> Float64:
    """Middles of the left and the right eye (2, 3): by the eyeballs, the lids, or the mouth."""
    found = []
    for side in ("left", "right"):
        balls = [
            piece.vertices
            for piece, name in zip(pieces, names, strict=True)
            if name.startswith(f"eye_{side}")
        ]
        lids = _moved(pieces, [f"eyeblink{side}"])
        if balls:
            whole = np.concatenate(balls)
            found.append((whole.min(axis=0) + whole.max(axis=0)) / 2)
        elif lids is not None:
            found.append(lids)
    if len(found) == 2:
        return np.array(found)
    mouth = _moved(pieces, [name for piece in pieces for name in piece.shapes])
    skin = max((piece for piece in pieces if piece.shapes), key=lambda piece: len(piece.vertices))
    near = np.abs(skin.vertices[:, 1] - (mouth if mouth is not None else skin.vertices.mean(0))[1])
    width = np.ptp(skin.vertices[near < np.quantile(near, 0.5), 0])
    unit = width / _HEAD_WIDTH
    middle = (mouth if mouth is not None else skin.vertices.mean(axis=0)) - MOUTH * unit
    half = np.array([unit / 2, 0, 0])
    return np.stack([middle + half, middle - half])


def _moved(pieces: list[Piece], names: list[str]) -> Float64 | None:
    """Mean place of what some shapes move."""
    total, place = 0.0, np.zeros(3)
    for piece in pieces:
        for name in set(names) & set(piece.shapes):
            size = np.linalg.norm(piece.shapes[name], axis=1)
            total += float(size.sum())
            place += size @ piece.vertices
    return place / total if total > 0 else None


def _pivot(glb: Glb, middle: Float64, unit: float) -> Float64:
    """Place of the joint that the head turns about."""
    for number, place in glb.nodes():
        node = glb.item("nodes", number)
        word = re.split(r"[.:|_ ]", str(node.get("name", "")).lower())[-1]
        at = place[:3, 3]
        if word == "head" and "mesh" not in node and np.linalg.norm(at - middle) < 4 * unit:
            return at
    return middle + PIVOT * unit


def _head_weight(pieces: list[Piece], height: Float64) -> Float64:
    """Share of the head's turn (V,); heights over the eyes are in eye distances."""
    shares = [piece.head_weight for piece in pieces if piece.head_weight is not None]
    return np.concatenate(shares) if len(shares) == len(pieces) else fade(height)


def _weights_by_fap(known: Names, *, gaze: bool) -> dict[str, Float64]:
    """Weight of each shape by one unit of every FAP (68,); the module's equation."""
    names = sorted(known)
    shapes = np.array([known[name] for name in names])
    if names[0] in _FAP_NAMES:
        return dict(zip(names, np.where(shapes > 0, 1 / np.maximum(shapes, 1), 0), strict=True))
    travel = _travel_m(gaze)
    matrix = shapes * travel
    gram = matrix @ matrix.T + _RIDGE_M**2 * np.eye(len(shapes))
    weights = np.linalg.solve(gram, matrix * travel)
    # what a shape does by less than 0.1 mm at 1 cm of travel is noise that would fill the basis
    weights[np.abs(weights) < 0.01 * travel / _TRAVEL_M] = 0
    return dict(zip(names, weights, strict=True))


def _fields(piece: Piece, weights: dict[str, Float64]) -> Fields:
    """Displacement (V, 3) of a piece's vertices by one unit of each FAP, m."""
    names = [name for name in piece.shapes if name in weights]
    if not names:
        return {}
    shifts = np.array([piece.shapes[name] for name in names])
    table = np.array([weights[name] for name in names])  # (shapes, 68)
    return {
        int(number) + 1: np.tensordot(table[:, number], shifts, axes=1)
        for number in np.flatnonzero(np.abs(table).max(axis=0))
    }


def _travel_m(gaze: bool) -> Float64:
    """Travel of a FAP's feature point by one unit, m; 0 for what no shape is to express."""
    fapu = standard_fapu()
    travel = np.zeros(NUM_FAPS)
    for fap in FAPS[2:]:
        if fap.fapu == "AU":
            eye = fap.number in (23, 24, 25, 26)
            counts = (eye and gaze) or fap.name == "tongue_roll"
            travel[fap.number - 1] = counts * _EYE_RADIUS_M * RADIANS_PER_ANGLE_UNIT
        else:
            travel[fap.number - 1] = fapu[fap.fapu] / FAP_UNITS_PER_FAPU
    return travel
