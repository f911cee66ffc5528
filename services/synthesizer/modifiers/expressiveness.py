"""How large the mouth's movements are beside those of the lip model: the user's choice.

A caricature: what differs from the usual mouth of speech differs more. Lips that are open open
further, narrow lips become narrower, spread lips wider, pushed lips are pushed further.

======  ==============================================  ========  =====
symbol  meaning                                         unit      shape
======  ==============================================  ========  =====
e       expressiveness                                  1
x       opening of one lip, or of the jaw               FAP       (1,)
d       width or push beside the usual one              FAP       (1,)
======  ==============================================  ========  =====

    x' = x + (e - 1) * s * (1 - s / 900)    s = min(max(x - 20, 0), 450)    for e > 1
    x' = x + (e - 1) * max(x - 20, 0)                                       for e < 1
    d' = d + 2 * (e - 1) * d

A closure is kept: a lip within ``SHUT`` of where it is shut does not move, two lips whose gap is
no larger keep it, and so do those whose lower one is shut against the teeth (f). Very open lips
open no further, so that no jaw drops too far. The movements from side to side are small, and weigh
as much to the eye: they count twice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.modifiers.modifier import Moment

SHUT = 20.0  # a gap up to this is a closure, FAP units
OPEN = 80.0  # from this gap on, the width of the lips is that of an open mouth
_WIDEST = 900.0  # an opening that grows no more
_USUAL_WIDTH = -40.0  # of a corner of the mouth in speech, by the dynamic visemes
_USUAL_PUSH = 40.0
_SIDEWAYS = 2.0
_MIN_WIDTH, _MAX_PUSH = -260.0, 400.0

JAW = 3 - 1
UPPER = np.array([4, 8, 9, 51, 55, 56]) - 1  # positive is down
LOWER = np.array([5, 10, 11, 52, 57, 58]) - 1  # positive is up; each meets the upper lip's
_WIDTH = np.array([6, 7, 53, 54]) - 1  # positive is outwards
_PUSH = np.array([16, 17]) - 1  # positive is forwards


class Expressiveness:
    """Makes the mouth's movements larger or smaller.

    Parameters
    ----------
    amount
        0.5 to 2; 1 changes nothing.
    """

    def __init__(self, amount: float) -> None:
        self.amount = amount

    def apply(self, faps: NDArray[np.float32], moment: Moment) -> None:
        """Change a frame, FAPs (68,), in place."""
        self.scale(faps)

    def scale(self, faps: NDArray[np.float32]) -> None:
        """Scale the mouth of FAPs (68,), in place."""
        if self.amount == 1.0:
            return
        upper, lower = -faps[UPPER], -faps[LOWER]  # openings
        beyond = np.maximum(upper + lower - SHUT, 0.0)  # (6,) of the gaps
        free_upper, free_lower = (np.maximum(lip - SHUT, 0.0) for lip in (upper, lower))
        free = free_upper + free_lower
        # the lower lip shut against the teeth (f) is a closure, too
        apart = np.minimum(free_lower / (OPEN - SHUT), 1.0)
        grown = apart * self._growth(np.minimum(free, beyond))
        share = grown / np.maximum(free, 1.0)
        faps[UPPER] -= share * free_upper
        faps[LOWER] -= share * free_lower
        gap = float(upper[0] + lower[0])
        is_open = float(apart[0]) * min(max((gap - SHUT) / (OPEN - SHUT), 0.0), 1.0)
        faps[JAW] += is_open * self._growth(np.maximum(faps[JAW], 0.0))
        width = faps[_WIDTH] - _USUAL_WIDTH
        # at rest the mouth is wider than in speech, which is no spreading
        change = _SIDEWAYS * self._more * np.where(width > 0.0, is_open * width, width)
        faps[_WIDTH] = np.maximum(faps[_WIDTH] + change, np.minimum(faps[_WIDTH], _MIN_WIDTH))
        pushed = _SIDEWAYS * self._more * np.maximum(faps[_PUSH] - _USUAL_PUSH, 0.0)
        faps[_PUSH] = np.minimum(faps[_PUSH] + pushed, np.maximum(faps[_PUSH], _MAX_PUSH))

    @property
    def _more(self) -> float:
        return self.amount - 1.0

    def _growth(self, opening: NDArray[np.float32]) -> NDArray[np.float32]:
        if self._more < 0.0:
            return self._more * opening
        within = np.minimum(opening, _WIDEST / 2)
        return np.asarray(self._more * within * (1.0 - within / _WIDEST), np.float32)
