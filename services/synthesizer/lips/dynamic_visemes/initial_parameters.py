"""Initial parameters of the dynamic visemes, set by hand; training starts from them.

Static targets are published values (``targets.tsv``). Dominances and decays are estimates. The
feature that defines a consonant dominates: closed lips for labials, closed teeth for sibilants.
Its other features yield to the vowel, especially in consonants that are articulated further back.
"""

import numpy as np

from kouxing.services.synthesizer.lips.dynamic_visemes.derived_visemes import append_derived_visemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import (
    VisemeParameters,
    fap_columns,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import (
    CLOSURE_FAPS,
    REST,
    ROUNDED_VISEMES,
    TRAINED_VISEMES,
    VISEME_INDEX,
    static_targets,
)
from kouxing.shared.face.faps import MOUTH_WIDTH_FAPS, NUM_MOUTH_FAPS, PROTRUSION_FAPS, TONGUE_FAPS

_JAW_FAPS = (3, 14)
_ROUNDING_FAPS = MOUTH_WIDTH_FAPS + PROTRUSION_FAPS

# consonant visemes: dominance over lip height, jaw and rounding, and decay
CONSONANTS = {
    "b": (3.0, 1.2, 0.4, 55.0),
    "f": (2.0, 1.2, 0.6, 55.0),
    "d": (0.6, 0.8, 0.3, 55.0),
    "l": (0.5, 0.6, 0.3, 55.0),
    "g": (0.35, 0.4, 0.25, 50.0),
    "j": (0.8, 1.0, 0.5, 50.0),
    "zh": (1.0, 1.3, 0.7, 50.0),
    "z": (1.0, 1.3, 0.6, 50.0),
}
_VOWEL_THETA = 42.0
_ROUNDED_ALPHA = 2.0
_ROUNDED_THETA_MINUS = 28.0  # lips start rounding early
_SILENCE_THETA = 40.0
_SILENCE_OFFSET_S = 0.12  # the mouth opens before the voice and closes after it
_INITIAL_C = 1.3
_MEAN_DISTANCE_S = 0.115  # mean distance of apexes; there, all exponents have the same decay
_CONSONANT_LEVEL_DB = -12.0  # relative to vowels


def initial_parameters(c: float = _INITIAL_C) -> VisemeParameters:
    """Return the parameters for an exponent ``c``."""
    shape = (len(TRAINED_VISEMES), NUM_MOUTH_FAPS)
    decay = _MEAN_DISTANCE_S ** (_INITIAL_C - c)
    alpha, closes = np.ones(shape), np.zeros(shape)
    level_db = np.zeros(len(TRAINED_VISEMES))
    theta_minus, theta_plus = np.full(shape, _VOWEL_THETA), np.full(shape, _VOWEL_THETA)
    for row, viseme in enumerate(TRAINED_VISEMES):
        group, _, variant = viseme.partition("_")
        if group in CONSONANTS:
            lips, jaw, rounding, theta = CONSONANTS[group]
            level_db[row] = _CONSONANT_LEVEL_DB
            alpha[row] = lips
            alpha[row, fap_columns(_JAW_FAPS)] = jaw
            alpha[row, fap_columns(_ROUNDING_FAPS)] = 2.0 * rounding if variant else rounding
            alpha[row, fap_columns(TONGUE_FAPS)] = 1.5
            theta_minus[row] = theta_plus[row] = theta
        elif viseme in ROUNDED_VISEMES:
            alpha[row, fap_columns(_ROUNDING_FAPS)] = _ROUNDED_ALPHA
            theta_minus[row, fap_columns(_ROUNDING_FAPS)] = _ROUNDED_THETA_MINUS
        closes[row, fap_columns(CLOSURE_FAPS.get(viseme, ()))] = 1.0
    trained = {
        "alpha": alpha,
        "theta_minus": theta_minus * decay,
        "theta_plus": theta_plus * decay,
        "offset_s": np.zeros(shape),
        "closes": closes,
        "level_db": level_db,
    }
    targets = static_targets()
    per_fap = np.ones(NUM_MOUTH_FAPS)
    return VisemeParameters(
        **append_derived_visemes(trained, VISEME_INDEX),
        target=targets,
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
