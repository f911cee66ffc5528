"""Shows laughter and audible breaths of the voice on the face.

Laughter opens the mouth, raises the corners and narrows the eyes; the head leans back (Ruch & Ekman
2001, "The expressive pattern of laughter"). A breath parts the lips, widens the nostrils and lifts
the head. It usually precedes speech. Lips that speech has closed stay closed.
"""

import math

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.modifiers.expression import SpeechExpression
from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.face.expression_motion import EXPRESSION_FAPS
from kouxing.shared.face.expressions import ExpressionName
from kouxing.shared.face.faps import FAP_NUMBER, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.high_level import VISEME_NAMES, VISEMES

_HOLD_S = 0.2  # time for which the last frame of laughter or breath is held
_LAUGHTER_OPENING, _BREATH_OPENING = 0.55, 0.3  # share of an open vowel's opening
_LAUGHTER_DEG, _BREATH_DEG = -4.0, -1.2  # the head's pitch; upwards
_NOSTRILS = 60.0  # FAP units
_DEGREE = math.radians(1.0) / RADIANS_PER_ANGLE_UNIT
_OPEN_VOWEL = VISEMES[VISEME_NAMES.index("A:")]
_HEAD_PITCH = FAP_NUMBER["head_pitch"] - 1


def _laughter() -> NDArray[np.float32]:
    faps: NDArray[np.float32]
    faps = EXPRESSION_FAPS[ExpressionName.JOY] + np.float32(_LAUGHTER_OPENING) * _OPEN_VOWEL
    faps[_HEAD_PITCH] = _LAUGHTER_DEG * _DEGREE
    return faps


def _breath() -> NDArray[np.float32]:
    faps: NDArray[np.float32] = np.float32(_BREATH_OPENING) * _OPEN_VOWEL
    for name in ("stretch_l_nose", "stretch_r_nose"):
        faps[FAP_NUMBER[name] - 1] = _NOSTRILS
    faps[_HEAD_PITCH] = _BREATH_DEG * _DEGREE
    return faps


class NonverbalSounds:
    """Shows laughter and breaths while they last."""

    def __init__(self) -> None:
        self._laughter, self._breath = SpeechExpression(), SpeechExpression()

    def apply(self, faps: NDArray[np.float32], context: FrameContext) -> None:
        """Add laughter and breath to a frame, FAPs (68,), in place."""
        if context.is_laughter:
            self._laughter.show_faps(_LAUGHTER, _HOLD_S)
        elif context.is_breath:
            self._breath.show_faps(_BREATH, _HOLD_S)
        self._laughter.apply(faps, context)
        self._breath.apply(faps, context)


_LAUGHTER, _BREATH = _laughter(), _breath()
