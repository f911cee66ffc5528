"""When a frame is sent: frames come when the network brings them, and leave at their own pace."""

from __future__ import annotations

import math

WINDOW_S = 2.0  # of frames, whose shortest way counts
PAUSE_S = 0.5  # a frame that comes so much later than the others follows a pause


class Playout:
    """Due times of frames.

    The frame that came the shortest way tells when each of the others could have come at best; it
    is due as long after that as the target is to be delayed. So without delay a frame is due when
    it comes, and a delay longer than ways differ leaves no jitter. Clocks drift, so only the last
    frames count. Where media time stands still, goes back or is late, ways are measured anew.
    """

    def __init__(self) -> None:
        self._time_s = -math.inf  # of the newest frame
        self._window_end_s = -math.inf
        self._shortest_s = self._shortest_before_s = math.inf  # in this window, and the one before

    def best_s(self, time_s: float, now_s: float) -> float:
        """Return when a frame that has just come could have come at best.

        Parameters
        ----------
        time_s
            Media time of the frame.
        now_s
            Time of any clock that goes on, as is the result, which is never later.
        """
        way_s = now_s - time_s
        shortest_s = min(self._shortest_s, self._shortest_before_s)
        if time_s <= self._time_s or way_s > shortest_s + PAUSE_S:
            self._shortest_s, self._window_end_s = math.inf, -math.inf
        if now_s > self._window_end_s:
            self._shortest_before_s, self._shortest_s = self._shortest_s, math.inf
            self._window_end_s = now_s + WINDOW_S
        self._time_s = time_s
        self._shortest_s = min(self._shortest_s, way_s)
        return time_s + min(self._shortest_s, self._shortest_before_s)
