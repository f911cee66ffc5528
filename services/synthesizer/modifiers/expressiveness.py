"""Scales mouth movements, like a caricature.

Differences from the usual mouth of speech grow: open lips open further, narrow lips become
narrower, spread lips wider, and protruding lips protrude further.

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

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.face.expression_motion import CLOSED, JAW, LOWER, OPEN, UPPER

_WIDEST = 900.0  # openings of this size do not grow
_USUAL_WIDTH = -40.0  # FAP of a mouth corner in speech, from the dynamic visemes
_USUAL_PUSH = 40.0
_SIDEWAYS = 2.0
_MIN_WIDTH, _MAX_PUSH = -260.0, 400.0

_LIPS = np.stack([UPPER, LOWER])
_WIDTH = np.array([6, 7, 53, 54]) - 1  # positive is outward
_PUSH = np.array([16, 17]) - 1  # positive is forward


class Expressiveness:
    """Scales mouth movements by ``amount``, 0.5 to 2; 1 changes nothing."""

    def __init__(self, amount: float) -> None:
        self.amount = amount

    def apply(self, faps: NDArray[np.float32], context: FrameContext | None = None) -> None:
        """Scale the mouth of FAPs (68,), in place."""
        if self.amount == 1.0:
            return
        openings = -faps[_LIPS]  # (2, 6) of the upper and the lower lip
        upper, lower = openings
        beyond = np.maximum(upper + lower - CLOSED, 0.0)  # (6,) excess of the gaps
        free_lips = np.maximum(openings - CLOSED, 0.0)  # (2, 6)
        free_upper, free_lower = free_lips
        free = free_upper + free_lower
        # a lower lip at the teeth (f) is also a closure
        apart = np.minimum(free_lower / (OPEN - CLOSED), 1.0)
        grown = apart * self._growth(np.minimum(free, beyond))
        faps[_LIPS] -= grown / np.maximum(free, 1.0) * free_lips
        gap = float(upper[0] + lower[0])
        is_open = float(apart[0]) * min(max((gap - CLOSED) / (OPEN - CLOSED), 0.0), 1.0)
        faps[JAW] += is_open * self._growth(np.maximum(faps[JAW], 0.0))
        before = faps[_WIDTH]
        width = before - _USUAL_WIDTH
        # at rest the mouth is wider than in speech, but not spread
        more = _SIDEWAYS * (self.amount - 1.0)
        change = more * np.where(width > 0.0, is_open * width, width)
        faps[_WIDTH] = np.maximum(before + change, np.minimum(before, _MIN_WIDTH))
        pushed = more * np.maximum(faps[_PUSH] - _USUAL_PUSH, 0.0)
        faps[_PUSH] = np.minimum(faps[_PUSH] + pushed, np.maximum(faps[_PUSH], _MAX_PUSH))

    def _growth(self, opening: NDArray[np.float32]) -> NDArray[np.float32]:
        more = self.amount - 1.0
        if more < 0.0:
            return more * opening
        within = np.minimum(opening, _WIDEST / 2)
        return np.asarray(more * within * (1.0 - within / _WIDEST), np.float32)
