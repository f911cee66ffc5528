"""Joins lip positions to a continuous mouth trajectory.

Cubic Hermite splines join the lip positions. The velocity at one of them is the slope of the line
from the previous one, so the mouth and its velocity are continuous without waiting for the next.
If lip positions are missing, the mouth moves to rest and back.
"""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from kouxing.services.synthesizer.lips.trajectory import FapState, stationary_state
from kouxing.shared.arrays import Doubles

HOLD_S = 0.04  # tolerated lateness of lip positions
CLOSE_S = 0.1  # time from the last lip positions to rest
_OPEN_S = 0.06  # time from rest to the first lip positions
MAX_GAP_S = CLOSE_S + _OPEN_S  # maximum distance of two lip positions that are joined


@dataclass(frozen=True, slots=True)
class _Knot:
    time_s: float
    state: FapState


class LipTrack:
    """A mouth trajectory that starts at rest, mouth FAPs (num_mouth_faps,)."""

    def __init__(self, neutral: Doubles) -> None:
        self.hold_s = 0.0  # how long the last lip positions are held before the mouth moves to rest
        self._rest = stationary_state(neutral)
        self._knots: list[_Knot] = []

    @property
    def end_s(self) -> float:
        """Time of the last lip positions, seconds; minus infinity before the first."""
        return self._knots[-1].time_s if self._knots else -np.inf

    def append(self, time_s: float, faps: Doubles) -> None:
        """Append lip positions: media time, FAPs (num_mouth_faps,)."""
        if time_s - self.end_s <= MAX_GAP_S:
            velocity = (faps - self._knots[-1].state.value) / (time_s - self.end_s)
        else:
            velocity = self._rest.velocity
            if self._knots:
                self._knots.append(_Knot(self.end_s + CLOSE_S, self._rest))
            self._knots.append(_Knot(time_s - _OPEN_S, self._rest))
        self._knots.append(_Knot(time_s, FapState(faps, velocity)))

    def forget_before(self, time_s: float) -> None:
        """Drop lip positions that are no longer needed after a time."""
        first = bisect_right(self._knots, time_s, key=lambda knot: knot.time_s) - 1
        del self._knots[: max(0, first)]

    def at(self, time_s: float) -> FapState:
        """Return the mouth at a media time."""
        knots = self._knots
        if not knots or time_s < knots[0].time_s:
            return self._rest
        if time_s >= knots[-1].time_s:
            knots = [*knots[-1:], *self._return_to_rest()]
        after = bisect_right(knots, time_s, key=lambda knot: knot.time_s)
        if after == len(knots):
            return self._rest
        return _interpolate(knots[after - 1], knots[after], time_s)

    def _return_to_rest(self) -> list[_Knot]:
        value = self._knots[-1].state.value
        rest = _Knot(self.end_s + self.hold_s + CLOSE_S, self._rest)
        if self.hold_s == 0.0:
            return [rest]
        return [_Knot(self.end_s + self.hold_s, stationary_state(value)), rest]


def _interpolate(before: _Knot, after: _Knot, time_s: float) -> FapState:
    """Return the cubic Hermite spline between two knots at a time."""
    duration_s = after.time_s - before.time_s
    u = (time_s - before.time_s) / duration_s
    start, end = before.state, after.state
    step = end.value - start.value
    value = (
        start.value
        + u * u * (3.0 - 2.0 * u) * step
        + u * (1.0 - u) * duration_s * ((1.0 - u) * start.velocity - u * end.velocity)
    )
    velocity = (
        6.0 * u * (1.0 - u) * step / duration_s
        + (1.0 - u) * (1.0 - 3.0 * u) * start.velocity
        + u * (3.0 * u - 2.0) * end.velocity
    )
    return FapState(value, velocity)
