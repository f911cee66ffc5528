"""A mouth over time, from lip frames.

Lip frames are joined by cubic Hermite splines. The slope at a frame is that of the line from the
frame before, so position and velocity are continuous and no frame waits for the next one. Where
frames are missing, the mouth goes to rest and comes back.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.trajectory import Motion, motionless

Array = NDArray[np.float64]

HOLD_S = 0.04  # a frame that is late may come this long after it was due
CLOSE_S = 0.1  # from the last frame to rest
_OPEN_S = 0.06  # from rest to the first frame
MAX_GAP_S = CLOSE_S + _OPEN_S  # between two frames that are joined


@dataclass(frozen=True, slots=True)
class _Knot:
    time_s: float
    motion: Motion


class LipTrack:
    """The mouth at any time.

    Parameters
    ----------
    neutral
        The mouth at rest, shape (num_mouth_faps,), FAP units.

    Attributes
    ----------
    hold_s : float
        How long the last frame holds before the mouth goes to rest.
    """

    def __init__(self, neutral: Array) -> None:
        self.hold_s = 0.0
        self._rest = motionless(neutral)
        self._knots: list[_Knot] = []

    @property
    def end_s(self) -> float:
        """Time of the last frame, seconds; before the first one minus infinity."""
        return self._knots[-1].time_s if self._knots else -np.inf

    def append(self, time_s: float, faps: Array) -> None:
        """Add a frame behind the last one: media time, FAPs (num_mouth_faps,)."""
        slope = np.zeros_like(faps)
        if time_s - self.end_s <= MAX_GAP_S:
            slope = (faps - self._knots[-1].motion.value) / (time_s - self.end_s)
        else:
            if self._knots:
                self._knots.append(_Knot(self.end_s + CLOSE_S, self._rest))
            self._knots.append(_Knot(time_s - _OPEN_S, self._rest))
        self._knots.append(_Knot(time_s, Motion(faps, slope)))

    def forget_before(self, time_s: float) -> None:
        """Forget frames that no time from here on needs."""
        first = bisect_right(self._knots, time_s, key=lambda knot: knot.time_s) - 1
        del self._knots[: max(0, first)]

    def at(self, time_s: float) -> Motion:
        """Return the mouth and its velocity at a media time."""
        knots = self._knots
        if not knots or time_s < knots[0].time_s:
            return self._rest
        if time_s >= knots[-1].time_s:
            knots = [*knots[-1:], *self._after_the_last()]
        after = bisect_right(knots, time_s, key=lambda knot: knot.time_s)
        if after == len(knots):
            return self._rest
        return _between(knots[after - 1], knots[after], time_s)

    def _after_the_last(self) -> list[_Knot]:
        value = self._knots[-1].motion.value
        rest = _Knot(self.end_s + self.hold_s + CLOSE_S, self._rest)
        if self.hold_s == 0.0:
            return [rest]
        return [_Knot(self.end_s + self.hold_s, motionless(value)), rest]


def _between(one: _Knot, other: _Knot, time_s: float) -> Motion:
    """Return the cubic Hermite spline from one knot to another at a time between them."""
    duration_s = other.time_s - one.time_s
    u = (time_s - one.time_s) / duration_s
    begin, end = one.motion, other.motion
    step = end.value - begin.value
    value = (
        begin.value
        + u * u * (3.0 - 2.0 * u) * step
        + u * (1.0 - u) * duration_s * ((1.0 - u) * begin.slope - u * end.slope)
    )
    slope = (
        6.0 * u * (1.0 - u) * step / duration_s
        + (1.0 - u) * (1.0 - 3.0 * u) * begin.slope
        + u * (3.0 * u - 2.0) * end.slope
    )
    return Motion(value, slope)
