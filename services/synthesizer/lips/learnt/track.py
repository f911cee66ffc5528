"""A mouth over time, from lip frames.

Lip frames are joined by straight lines and averaged over the 20 ms around each time. Where frames
come every 20 ms this is a quadratic B-spline: position and velocity are continuous, and no frame
counts beyond its two neighbours. Where frames are missing, the mouth goes to rest and comes back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.lips.dynamic_visemes.trajectory import Motion

Array = NDArray[np.float64]

HOLD_S = 0.04  # a frame that is late may come this long after it was due
CLOSE_S = 0.1  # from the last frame to rest
_OPEN_S = 0.06  # from rest to the first frame
_REACH_S = 0.01  # half of the time that is averaged


class LipTrack:
    """The mouth at any time.

    Parameters
    ----------
    time_s
        Times of the lip frames, shape (n,), rising; media time.
    faps
        Their FAPs, shape (n, num_mouth_faps), FAP units.
    neutral
        The mouth at rest, shape (num_mouth_faps,).
    hold_s
        How long the last frame holds before the mouth goes to rest.
    """

    def __init__(self, time_s: Array, faps: Array, neutral: Array, hold_s: float) -> None:
        times: list[float] = []
        rows: list[Array] = []
        last_s = -np.inf
        for frame_s, row in zip(time_s, faps, strict=True):
            if frame_s - last_s > CLOSE_S + _OPEN_S:
                if rows:
                    times.append(last_s + CLOSE_S)
                    rows.append(neutral)
                times.append(frame_s - _OPEN_S)
                rows.append(neutral)
            times.append(frame_s)
            rows.append(row)
            last_s = frame_s
        if rows:
            if hold_s > 0.0:
                times.append(last_s + hold_s)
                rows.append(rows[-1])
            times.append(last_s + hold_s + CLOSE_S)
            rows.append(neutral)
        self._times = np.array([*times, np.inf])
        self._rows = np.array([*rows, neutral])
        self._neutral = neutral

    def at(self, time_s: float) -> Motion:
        """Return the mouth and its velocity at a media time."""
        begin_s, end_s = time_s - _REACH_S, time_s + _REACH_S
        first, last = np.searchsorted(self._times, [begin_s, end_s])
        begin, end = self._line(begin_s), self._line(end_s)
        times = np.array([begin_s, *self._times[first:last], end_s])
        rows = np.array([begin, *self._rows[first:last], end])
        area = np.diff(times) @ (rows[1:] + rows[:-1]) / 2.0
        width_s = end_s - begin_s
        return Motion(area / width_s, (end - begin) / width_s)

    def _line(self, time_s: float) -> Array:
        """Return the straight line between two frames at a time."""
        after = int(np.searchsorted(self._times, time_s))
        if after == 0 or after == len(self._times) - 1:
            return self._neutral
        begin_s, end_s = self._times[after - 1 : after + 1]
        share = (time_s - begin_s) / (end_s - begin_s)
        line: Array = (1.0 - share) * self._rows[after - 1] + share * self._rows[after]
        return line
