"""Shows expressions on the face, and laughter and audible breaths of the voice.

Laughter opens the mouth, raises the corners and narrows the eyes; the head leans back (Ruch & Ekman
2001, "The expressive pattern of laughter"). A laugh is a series of notes ("ha"), about 4.8 per
second, with pauses for breath (Provine & Yong 1991, "Laughter: a stereotyped human vocalization").
Mouth and head follow the level ``L`` of the notes relative to the loudest recent note ``P``, in dB:

    loudness = 1 + (L - P) / 30    limited to 0 to 1

A breath opens the lips, widens the nostrils and lifts the head. It usually precedes speech. Lips
that are closed for speech stay closed.
"""

import math
from collections import deque

import numpy as np

from kouxing.services.synthesizer.modifiers.modifier import FrameContext, pop_until
from kouxing.shared.arrays import Floats
from kouxing.shared.face.expression_motion import EXPRESSION_FAPS, ExpressionMotion
from kouxing.shared.face.expressions import ExpressionName
from kouxing.shared.face.faps import DEGREE, FAP_NUMBER
from kouxing.shared.face.high_level_faps import VISEME_NAMES, VISEMES

_HOLD_S = 0.2  # time for which the last frame of laughter or breath is held
_BREATH_OPENING = 0.3  # fraction of an open vowel's opening
_LAUGH_OPENING = (0.12, 0.58)  # the same, in silence and added by the loudest notes
_LAUGH_SQUINT = 0.5  # rise of the lower lids, as a fraction of a squint
_LAUGH_DEG, _BREATH_DEG = (-2.5, -2.0), -1.2  # pitch of the head; negative is upward
_LEAD_S = 0.06  # levels act this much earlier, if known, to compensate for the filter
_LAUGH_EASE_S = 0.045  # time constant of each filter pole; notes remain visible
_LOUDNESS_DB, _FORGET_DB_S = 30.0, 6.0  # range of the loudness; decay of P per second
_NOSTRILS = 60.0  # FAP units
_OPEN_VOWEL = VISEMES[VISEME_NAMES.index("A:")]
_HEAD_PITCH = FAP_NUMBER["head_pitch"] - 1


def _open_mouth(amount: float, pitch_deg: float) -> Floats:
    """Return FAPs (68,) of an open mouth and a lifted head."""
    faps: Floats = np.float32(amount) * _OPEN_VOWEL
    faps[_HEAD_PITCH] = pitch_deg * DEGREE
    return faps


def _make_breath() -> Floats:
    faps = _open_mouth(_BREATH_OPENING, _BREATH_DEG)
    for name in ("stretch_l_nose", "stretch_r_nose"):
        faps[FAP_NUMBER[name] - 1] = _NOSTRILS
    return faps


class ExpressionModifier(ExpressionMotion):
    """Expressions that leave the lips to speech."""

    def apply(self, faps: Floats, context: FrameContext) -> None:
        """Add the expressions to a frame, FAPs (68,), in place."""
        self.add(faps, context.step_s, is_speaking=context.is_speaking)


class NonverbalModifier:
    """Adds laughter and breaths to the face while they last."""

    def __init__(self) -> None:
        self._laughter, self._breath = ExpressionModifier(_LAUGH_EASE_S), ExpressionModifier()
        self._levels: deque[tuple[float, float]] = deque()
        self._loudest_db = -math.inf
        self._loudness = 0.0

    def apply(self, faps: Floats, context: FrameContext) -> None:
        """Add laughter and breath to a frame, FAPs (68,), in place."""
        self._levels += context.levels
        until_s = min(context.known_s, context.time_s + _LEAD_S)
        self._loudest_db -= _FORGET_DB_S * context.step_s
        for _, level_db in pop_until(self._levels, until_s):
            self._loudest_db = max(self._loudest_db, level_db)
            self._loudness = max(1.0 + (level_db - self._loudest_db) / _LOUDNESS_DB, 0.0)
        if context.is_laughter:
            self._laughter.show_faps(_SMILING + np.float32(self._loudness) * _LOUD_NOTE, _HOLD_S)
        elif context.is_breath:
            self._breath.show_faps(_BREATH, _HOLD_S)
        self._laughter.apply(faps, context)
        self._breath.apply(faps, context)


_BREATH = _make_breath()
_SMILING = (
    EXPRESSION_FAPS[ExpressionName.JOY]
    + np.float32(_LAUGH_SQUINT) * EXPRESSION_FAPS[ExpressionName.SQUINT]
    + _open_mouth(_LAUGH_OPENING[0], _LAUGH_DEG[0])
)
_LOUD_NOTE = _open_mouth(_LAUGH_OPENING[1], _LAUGH_DEG[1])
