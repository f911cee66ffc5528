"""The dynamic visemes' parameters as set by hand: where learning starts, and a cross-check.

Static targets are published ones (``targets.tsv``). Dominances and decays are guesses: what the ear
needs of an initial stays (lips shut for labials, teeth shut for sibilants), the rest gives way to
the vowel, the more the further back the tongue works.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.parameters import NUM_MOUTH_FAPS, VisemeParameters
from services.synthesizer.visemes import (
    CLOSURE_FAPS,
    MOUTH_FAPS,
    REST,
    ROUNDED_SHAPES,
    VISEME_INDEX,
    VISEMES,
    static_targets,
)

_JAW_FAPS = (3, 14)
_ROUNDING_FAPS = (6, 7, 16, 17, 53, 54)  # mouth width and protrusion
_TONGUE_FAPS = (44, 45, 46, 47)

# Dominance of initials over lip height, jaw and rounding, and their decay.
INITIALS = {
    "b": (3.0, 1.2, 0.4, 55.0),
    "f": (2.0, 1.2, 0.6, 55.0),
    "d": (0.6, 0.8, 0.3, 55.0),
    "l": (0.5, 0.6, 0.3, 55.0),
    "g": (0.35, 0.4, 0.25, 50.0),
    "j": (0.8, 1.0, 0.5, 50.0),
    "zh": (1.0, 1.3, 0.7, 50.0),
    "z": (1.0, 1.3, 0.6, 50.0),
}
_FINAL_THETA = 42.0
_ROUNDED_ALPHA = 2.0
_ROUNDED_THETA_MINUS = 28.0  # lips round early
_SILENCE_THETA = 40.0
_SILENCE_OFFSET_S = 0.12  # the mouth opens before the voice and closes after it
_START_C = 1.3
_USUAL_DISTANCE_S = 0.115  # between centres: where decays of different exponents are compared
_INITIAL_LEVEL_DB = -12.0  # beside vowels


def columns(faps: Sequence[int]) -> NDArray[np.intp]:
    """Columns of the parameter arrays that hold some FAPs."""
    return np.array([MOUTH_FAPS.index(fap) for fap in faps], dtype=np.intp)


def starting_parameters(c: float = _START_C) -> VisemeParameters:
    """Parameters set by hand, for an exponent ``c``."""
    shape = (len(VISEMES), NUM_MOUTH_FAPS)
    decay = _USUAL_DISTANCE_S ** (_START_C - c)  # the same at the usual distance
    alpha, closes = np.ones(shape), np.zeros(shape)
    level_db = np.zeros(len(VISEMES))
    theta_minus, theta_plus = np.full(shape, _FINAL_THETA), np.full(shape, _FINAL_THETA)
    for viseme, row in VISEME_INDEX.items():
        group, _, variant = viseme.partition("_")
        if group in INITIALS:
            lips, jaw, rounding, theta = INITIALS[group]
            level_db[row] = _INITIAL_LEVEL_DB
            alpha[row] = lips
            alpha[row, columns(_JAW_FAPS)] = jaw
            alpha[row, columns(_ROUNDING_FAPS)] = 2.0 * rounding if variant else rounding
            alpha[row, columns(_TONGUE_FAPS)] = 1.5
            theta_minus[row] = theta_plus[row] = theta
        elif viseme in ROUNDED_SHAPES:
            alpha[row, columns(_ROUNDING_FAPS)] = _ROUNDED_ALPHA
            theta_minus[row, columns(_ROUNDING_FAPS)] = _ROUNDED_THETA_MINUS
        closes[row, columns(CLOSURE_FAPS.get(viseme, ()))] = 1.0
    targets = static_targets()
    per_fap = np.ones(NUM_MOUTH_FAPS)
    return VisemeParameters(
        alpha=alpha,
        theta_minus=theta_minus * decay,
        theta_plus=theta_plus * decay,
        offset_s=np.zeros(shape),
        target=targets,
        closes=closes,
        level_db=level_db,
        alpha_left=per_fap,
        alpha_right=per_fap,
        theta_left=_SILENCE_THETA * decay * per_fap,
        theta_right=_SILENCE_THETA * decay * per_fap,
        offset_left_s=-_SILENCE_OFFSET_S * per_fap,
        offset_right_s=_SILENCE_OFFSET_S * per_fap,
        neutral=targets[VISEME_INDEX[REST]],
        c=c,
        closure_ratio=1000.0,
        closure_reach_s=0.07,
    )
