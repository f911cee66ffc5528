"""The morph targets of an exported head: FAPs, ARKit's shapes and VRM's expressions."""

from typing import NamedTuple

import numpy as np

from kouxing.shared.arrays import Floats
from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.high_level_faps import EXPRESSION_NAMES, EXPRESSIONS
from kouxing.shared.face.shapes import ARKIT, VRM

_ANGLE_UNITS_PER_WEIGHT = 1 / RADIANS_PER_ANGLE_UNIT  # a weight of 1 is 1 rad
_MIN_FAP_SHIFT_M = 2e-5
_MIN_SHIFT_M = 1.5e-4
EMOTIONS = {"happy": "joy", "angry": "anger", "sad": "sadness", "surprised": "surprise"}


class MorphTarget(NamedTuple):
    """A morph target to export."""

    name: str
    faps: Floats  # (68,) at weight 1
    min_shift_m: float = _MIN_SHIFT_M  # smaller displacements are omitted
    turns_eyes: bool = True  # whether it moves the eyeballs; otherwise nodes rotate them


def units_per_weight(fapu: str) -> float:
    """Return the FAP units of weight 1 for a FAP with this unit."""
    return _ANGLE_UNITS_PER_WEIGHT if fapu == "AU" else FAP_UNITS_PER_FAPU


_FAP_UNITS = np.diag([units_per_weight(fap.fapu) for fap in FAPS]).astype(np.float32)
FAP_MORPHS = tuple(
    MorphTarget(fap.name, row, _MIN_FAP_SHIFT_M, turns_eyes=False)
    for fap, row in zip(FAPS, _FAP_UNITS, strict=True)
)
ARKIT_MORPHS = tuple(
    MorphTarget(name, faps) for name, faps in zip(ARKIT.names, ARKIT.basis, strict=True)
)
AVATAR_MORPHS = (
    *(MorphTarget(name, faps) for name, faps in zip(VRM.names, VRM.basis, strict=True)),
    *(MorphTarget(new, EXPRESSIONS[EXPRESSION_NAMES.index(old)]) for new, old in EMOTIONS.items()),
    *ARKIT_MORPHS,
)
