"""Moves the face with the arousal and valence of the voice.

Aroused voices raise the brows, open the lids, lift the head and enlarge the mouth's movements.
Tired voices do the opposite. Pleasant voices raise the corners of the mouth and the lower lids.
Unpleasant voices draw the brows together (Ekman & Friesen 1978, "Facial action coding system":
action units 1, 2, 4, 5, 6, 12 and 15). Closures stay closed, as in
:mod:`kouxing.services.synthesizer.modifiers.expressiveness`.
"""

import numpy as np

from kouxing.services.synthesizer.modifiers.expressiveness import scale_mouth
from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.arrays import Floats
from kouxing.shared.face.faps import DEGREE, FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.smoothing import TwoPoleFilter

_GAIN = 2.5  # usual voices differ from their mean by up to 0.4
_FILTER_S = 0.4  # time constant of each filter pole
_VISIBLE = 1e-3  # weaker feelings are not shown
_SIZE = 0.25  # increase of the mouth's movements at full arousal


def _named_faps(**units: float) -> Floats:
    """Return FAPs (68,) from units by name; ``S`` in a name means both sides."""
    faps = np.zeros(NUM_FAPS, np.float32)
    for name, value in units.items():
        for side in ("l", "r"):
            faps[FAP_NUMBER[name.replace("S", side)] - 1] = value
    return faps


# FAP units at full arousal and valence, upwards and downwards
_AROUSED = _named_faps(
    raise_S_i_eyebrow=30.0,
    raise_S_m_eyebrow=50.0,
    raise_S_o_eyebrow=45.0,
    close_t_S_eyelid=-110.0,
    head_pitch=-1.5 * DEGREE,
)
_TIRED = _named_faps(
    raise_S_m_eyebrow=-15.0,
    raise_S_o_eyebrow=-25.0,
    close_t_S_eyelid=170.0,
    head_pitch=2.0 * DEGREE,
)
_PLEASANT = _named_faps(
    raise_S_cornerlip=110.0,
    raise_S_cornerlip_o=110.0,
    close_b_S_eyelid=90.0,
    lift_S_cheek=40.0,
)
_UNPLEASANT = _named_faps(
    raise_S_cornerlip=-60.0,
    raise_S_cornerlip_o=-60.0,
    squeeze_S_eyebrow=35.0,
    raise_S_o_eyebrow=-10.0,
)


class FeelingModifier:
    """Shows the feeling in the voice with a strength of ``amount``, 0 to 1; 0 turns it off."""

    def __init__(self, amount: float) -> None:
        self.amount = amount
        self._arousal, self._valence = TwoPoleFilter(0.0), TwoPoleFilter(0.0)

    def apply(self, faps: Floats, context: FrameContext) -> None:
        """Add the feeling to a frame, FAPs (68,), in place."""
        arousal, valence = (
            motion.step(self._goal(value, context), context.step_s, _FILTER_S)
            for motion, value in zip((self._arousal, self._valence), context.feeling, strict=True)
        )
        if abs(arousal) > _VISIBLE:
            scale_mouth(faps, 1.0 + _SIZE * arousal)
            faps += np.float32(abs(arousal)) * (_AROUSED if arousal > 0.0 else _TIRED)
        if abs(valence) > _VISIBLE:
            faps += np.float32(abs(valence)) * (_PLEASANT if valence > 0.0 else _UNPLEASANT)

    def _goal(self, value: float, context: FrameContext) -> float:
        if not context.is_speaking:
            return 0.0
        return self.amount * min(max(_GAIN * value, -1.0), 1.0)
