"""Measure ARKit's shapes in FAPs: writes ``shared/face/arkit.tsv``.

Every shape is one of MakeHuman's face units (CC0). The FAPs ``f`` that come nearest to it on the
reference head solve

    (B^T B + w J^T J + l I) f = B^T u + w J^T j

======  ====================================================  ======  =============
symbol  meaning                                               unit    shape
======  ====================================================  ======  =============
B       fields of the shape's FAPs on the outer face          dm      (3 V, K)
u       the face unit there                                   dm      (3 V,)
J, j    the same for the lower front teeth: the jaw is bone   dm      (3, K), (3,)
w, l    weight of the teeth, and of small values
======  ====================================================  ======  =============

Each shape may use the FAPs of its region only. Left and right are averaged. Deviations: MakeHuman's
jawOpen is wider than any speaker's and counts 0.65; eyeBlink is the lids as ``idle_motion`` shuts
them, where MakeHuman's go on; mouthClose takes the lips back to where they meet; the eyes turn by
MakeHuman's angles; and the tongue comes out as far as its, but over the lower lip.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, NUM_FAPS
from kouxing.shared.face.idle_motion import LOWER_LID, UPPER_LID
from kouxing.training.heads.assemble import Builder

Float = NDArray[np.float64]

_LIPS = (*range(4, 14), 16, 17, 18, *range(51, 61))
_HEIGHTS = (4, 5, *range(8, 14), 51, 52, *range(55, 61))  # of the lips
_REGIONS: dict[str, tuple[int, ...]] = {  # by the beginning of a shape's name; the first that fits
    "jawOpen": (3, *_HEIGHTS),
    "brow": tuple(range(31, 39)),
    "cheekPuff": (*range(39, 43), *_LIPS),
    "cheekSquint": (21, 22, *range(39, 43)),
    "eye": tuple(range(19, 23)),
    "jaw": (3, 14, 15, *_LIPS),
    "mouth": (*_LIPS, *range(39, 43)),
    "noseSneer": (8, 9, *range(31, 35), 41, 42, 55, 56, *range(61, 65)),
}
_JAW_OPEN = 0.65
_BLINK = {19: UPPER_LID, 21: LOWER_LID}
_LOOKS = {"In": (-43e3, 0.0), "Out": (43e3, 0.0), "Up": (0.0, -21e3), "Down": (0.0, 31e3)}
_TONGUE_OUT = {44: 300.0, 45: 585.0, 46: 150.0}
_TEETH_WEIGHT = 2e4
_SMALL_WEIGHT = 3e-3  # of the median of the fields' own squares
_LEAST = 15.0  # FAP units; less is left out


def write_arkit_table(builder: Builder, path: Path) -> None:
    """Measure all shapes and write the table."""
    faps, units, teeth = builder.measured()
    names = sorted(units)
    shapes = {
        name: _fit(name, faps, units[name], teeth[name]) for name in names if name != "tongueOut"
    }
    shapes["tongueOut"] = np.zeros(NUM_FAPS + 1)
    for fap, value in _TONGUE_OUT.items():
        shapes["tongueOut"][fap] = value
    table = {name: (shapes[name] + _mirrored(shapes[_other(name)])) / 2 for name in names}
    for name, row in table.items():
        if name.startswith("eyeLook"):
            right = int(name.endswith("Right"))
            yaw, pitch = _LOOKS[name.removeprefix("eyeLook").removesuffix(("Left", "Right")[right])]
            row[23 + right], row[25 + right] = (-yaw if right else yaw), pitch
        elif name.startswith("eyeBlink"):
            row[:] = 0.0
            for fap, value in _BLINK.items():
                row[fap + name.endswith("Right")] = value
        row[np.abs(row) < _LEAST] = 0.0
    table["mouthClose"] = -table["jawOpen"]
    table["mouthClose"][3] = 0.0
    used = [fap for fap in range(3, NUM_FAPS + 1) if any(row[fap] for row in table.values())]
    lines = ["\t".join(["shape", *(f"fap{fap}" for fap in used)])]
    lines += ["\t".join([name, *(f"{table[name][fap]:.0f}" for fap in used)]) for name in names]
    path.write_text("\n".join(lines).replace("\t-0", "\t0") + "\n", encoding="utf-8")


def _fit(name: str, faps: dict[int, tuple[Float, Float]], unit: Float, teeth: Float) -> Float:
    """Find the FAPs (69,), by number, of a face unit (V, 3) that moves the teeth (3,)."""
    region = next(region for start, region in _REGIONS.items() if name.startswith(start))
    fields = np.stack([faps[fap][0].ravel() for fap in region], axis=1) / FAP_UNITS_PER_FAPU
    jaw = np.stack([faps[fap][1] for fap in region], axis=1) / FAP_UNITS_PER_FAPU
    square = fields.T @ fields
    left = square + _TEETH_WEIGHT * jaw.T @ jaw
    left += _SMALL_WEIGHT * np.median(np.diag(square)) * np.eye(len(region))
    found = np.zeros(NUM_FAPS + 1)
    found[list(region)] = np.linalg.solve(
        left, fields.T @ unit.ravel() + _TEETH_WEIGHT * jaw.T @ teeth
    )
    return found * (_JAW_OPEN if name == "jawOpen" else 1.0)


def _other(name: str) -> str:
    """Name the shape of the other side."""
    swaps = {"Left": "Right", "Right": "Left"}
    side = next((side for side in swaps if name.endswith(side)), "")
    return name.removesuffix(side) + swaps.get(side, "")


def _mirrored(faps: Float) -> Float:
    """Swap left and right of FAPs (69,)."""
    number = {fap.name: fap.number for fap in FAPS}
    swapped = faps.copy()
    for fap in FAPS:
        for left, right in (("_l_", "_r_"), ("_lm", "_rm")):
            other = number.get(fap.name.replace(left, right), 0)
            if left in fap.name and other and other != fap.number:
                swapped[[fap.number, other]] = faps[[other, fap.number]]
    swapped[[15, 43, 64]] *= -1  # to one side
    return swapped
