"""Exaggerates or reduces mouth movements.

Exaggeration increases differences from the usual mouth of speech: open lips open further, narrow
lips become narrower, spread lips wider, and protruding lips protrude further.

======  ==============================================  ========  =====
symbol  meaning                                         unit      shape
======  ==============================================  ========  =====
e       expressiveness                                  1
x       opening of one lip, or of the jaw               FAP       (1,)
d       difference from the usual width or protrusion   FAP       (1,)
======  ==============================================  ========  =====

    x' = x + (e - 1) * s * (1 - s / 900)    s = min(max(x - 20, 0), 450)    for e > 1
    x' = x + (e - 1) * max(x - 20, 0)                                       for e < 1
    d' = d + 2 * (e - 1) * d

Closures are preserved. A lip within ``CLOSED`` of its closed position does not move. Lips keep
their gap if it is at most ``CLOSED``, or if the lower lip touches the teeth (f). Very wide openings
do not grow, so that the jaw does not drop too far. Horizontal movements are small but equally
visible, so they count twice.
"""

from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.arrays import Floats
from kouxing.shared.face.expression_motion import CLOSED, JAW, LOWER, OPEN, UPPER
from kouxing.shared.face.faps import MOUTH_WIDTH_FAPS
from kouxing.shared.face.smoothing import TwoPoleFilter

_WIDEST = 900.0  # openings of this size or more do not grow
_USUAL_WIDTH = -40.0  # FAP of a mouth corner in speech, from the dynamic visemes
_USUAL_PUSH = 40.0
_SIDEWAYS = 2.0
_MIN_WIDTH, _MAX_PUSH = -260.0, 400.0
_EASE_S = 0.05  # time constant of each filter pole after a change of the amount

_LIPS = [*zip(UPPER.tolist(), LOWER.tolist(), strict=True)]  # the middle of the inner lips first
_WIDTH = tuple(fap - 1 for fap in MOUTH_WIDTH_FAPS)
_PUSH = (15, 16)  # FAP 16 and 17; positive is forward


class ExpressivenessModifier:
    """Scales mouth movements by ``amount``, 0.5 to 2; 1 changes nothing. Changes are smooth."""

    def __init__(self, amount: float) -> None:
        self.amount = amount
        self._shown = TwoPoleFilter(amount)

    def apply(self, faps: Floats, context: FrameContext) -> None:
        """Scale the mouth of a frame, FAPs (68,), in place."""
        scale_mouth(faps, self._shown.step(self.amount, context.step_s, _EASE_S))


def scale_mouth(faps: Floats, amount: float) -> None:
    """Scale the mouth movements of FAPs (68,) by ``amount``, in place."""
    if amount == 1.0:
        return
    # For so few numbers, floats are faster than arrays.
    values = faps.tolist()
    more = amount - 1.0
    openness = 0.0  # at the middle of the inner lips, 0 to 1
    for upper, lower in _LIPS:
        opening = -values[upper] - values[lower]
        beyond = max(opening - CLOSED, 0.0)  # excess of the gap
        free_upper, free_lower = (
            max(-values[upper] - CLOSED, 0.0),
            max(-values[lower] - CLOSED, 0.0),
        )
        free = free_upper + free_lower
        # a lower lip at the teeth (f) is also a closure
        apart = min(free_lower / (OPEN - CLOSED), 1.0)
        if upper == _LIPS[0][0]:
            openness = apart * min(beyond / (OPEN - CLOSED), 1.0)
        grown = apart * _growth(min(free, beyond), more) / max(free, 1.0)
        faps[upper] = values[upper] - grown * free_upper
        faps[lower] = values[lower] - grown * free_lower
    faps[JAW] = values[JAW] + openness * _growth(max(values[JAW], 0.0), more)
    for fap in _WIDTH:
        before = values[fap]
        width = before - _USUAL_WIDTH
        # at rest, the mouth is wider than in speech, but not spread
        change = _SIDEWAYS * more * width * (openness if width > 0.0 else 1.0)
        faps[fap] = max(before + change, min(before, _MIN_WIDTH))
    for fap in _PUSH:
        before = values[fap]
        pushed = _SIDEWAYS * more * max(before - _USUAL_PUSH, 0.0)
        faps[fap] = min(before + pushed, max(before, _MAX_PUSH))


def _growth(opening: float, more: float) -> float:
    """Return the change of an opening for e - 1 = ``more``."""
    if more < 0.0:
        return more * opening
    within = min(opening, _WIDEST / 2)
    return more * within * (1.0 - within / _WIDEST)
