"""Mandarin units as mouth shapes.

Source: Li et al. 2011, table 1 (visemes of initials and single-shape finals; compound finals are
split into single shapes, "iao = i + ao"). The table loses the finals after ``v``; the split of
those, and the second, rounded variant of an initial that stands before a rounded final, follow
Crystal.TTVS (Tsinghua University, Apache-2.0), as do the static targets in ``targets.tsv``.

Deviations: ``eng`` is table 1's {e, eng}, where Crystal has {ei, en, eng}. The vowels ``ii`` and
``iii`` hold the shape of the initials they follow.
"""

from __future__ import annotations

from importlib import resources

import numpy as np
from numpy.typing import NDArray

from shared.errors import UserError
from shared.phones import SILENCE

REST = "rest"
VISEMES = (
    REST,
    *"b f d d_rounded l l_rounded g g_rounded j j_rounded zh zh_rounded z z_rounded".split(),
    *"a ai ao o ou e ei er i u v".split(),
)
VISEME_INDEX = {viseme: index for index, viseme in enumerate(VISEMES)}

# The FAPs a viseme sets: jaw, lips, tongue.
MOUTH_FAPS = (*range(3, 15), 16, 17, *range(44, 48), *range(51, 61))

# What must meet for a closed mouth: every upper and lower lip height, inner and outer.
LIP_HEIGHT_FAPS = (4, 5, 8, 9, 10, 11, 51, 52, 55, 56, 57, 58)
# Lip to teeth: the lower lip alone.
LOWER_LIP_FAPS = (5, 10, 11, 52, 57, 58)
CLOSURE_FAPS = {"b": LIP_HEIGHT_FAPS, "f": LOWER_LIP_FAPS}

ROUNDED_SHAPES = frozenset({"u", "v"})
_GLIDE_SHARE = 0.35  # of a compound final's duration; its nucleus has the rest

_INITIAL_GROUPS = {
    "b": "b p m",
    "f": "f",
    "d": "d t n",
    "l": "l",
    "g": "g k h",
    "j": "j q x",
    "zh": "zh ch sh r",
    "z": "z c s",
}
_SINGLE_SHAPES = {
    "a": "a ang",
    "ai": "ai an",
    "ao": "ao",
    "o": "o",
    "ou": "ou",
    "e": "e eng",
    "ei": "ei en",
    "er": "er",
    "i": "i",
    "u": "u ong",
    "v": "v",
    "zh": "iii",
    "z": "ii",
}
_COMPOUNDS = {
    "ia": "i a", "ie": "i e", "iao": "i ao", "iou": "i ou", "ian": "i ai", "in": "i ei",
    "iang": "i a", "ing": "i e", "iong": "v u",
    "ua": "u a", "uo": "u o", "uai": "u ai", "uei": "u ei", "uan": "u ai", "uen": "u ei",
    "uang": "u a", "ueng": "u e",
    "ve": "v e", "van": "v ai", "vn": "v ei",
}  # fmt: skip

# unit -> its shapes in order, each with its share of the unit's duration
SHAPES: dict[str, tuple[tuple[str, float], ...]] = {
    **{unit: ((shape, 1.0),) for shape, units in _INITIAL_GROUPS.items() for unit in units.split()},
    **{unit: ((shape, 1.0),) for shape, units in _SINGLE_SHAPES.items() for unit in units.split()},
    **{
        unit: ((pair.split()[0], _GLIDE_SHARE), (pair.split()[1], 1.0 - _GLIDE_SHARE))
        for unit, pair in _COMPOUNDS.items()
    },
    SILENCE: ((REST, 1.0),),
}
_INITIALS_WITH_VARIANT = frozenset(
    unit for shape, units in _INITIAL_GROUPS.items() if f"{shape}_rounded" in VISEME_INDEX
    for unit in units.split()
)  # fmt: skip


def shapes_of(unit: str, next_unit: str | None) -> tuple[tuple[str, float], ...]:
    """Visemes of a unit in order, each with its share of the unit's duration.

    Parameters
    ----------
    unit : str
        One of ``shared.phones.UNITS``.
    next_unit : str or None
        The unit that follows without a pause, if it is known: an initial before a rounded final
        takes its rounded variant.
    """
    shapes = SHAPES[unit]
    if (
        next_unit is not None
        and unit in _INITIALS_WITH_VARIANT
        and SHAPES[next_unit][0][0] in ROUNDED_SHAPES
    ):
        return ((f"{shapes[0][0]}_rounded", 1.0),)
    return shapes


def static_targets() -> NDArray[np.float64]:
    """Read the static targets T, shape (num_visemes, num_mouth_faps), in FAP units."""
    text = resources.files("services.synthesizer").joinpath("targets.tsv").read_text("utf-8")
    lines = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    if lines[0][1:] != [str(fap) for fap in MOUTH_FAPS]:
        raise UserError("targets.tsv: the columns are not the mouth FAPs; restore the file")
    rows = {row[0]: [float(value) for value in row[1:]] for row in lines[1:]}
    return np.array([rows[viseme] for viseme in VISEMES])
