"""When a frame is sent: frames arrive with network jitter and leave at their own pace."""

from __future__ import annotations

import math

WINDOW_S = 2.0  # period in which the smallest network delay counts
PAUSE_S = 0.5  # a frame that is this much later than the others follows a pause


class PlayoutClock:
    """Removes network jitter from frame times.

    The frame with the smallest network delay defines when every other frame could have arrived at
    the earliest. A frame is due at that time plus the target's delay. Without a delay it is due on
    arrival; a delay above the jitter removes the jitter. Clocks drift, so only recent frames count.
    The delay is measured again when media time stops, goes back or is late.
    """

    def __init__(self) -> None:
        self._time_s = -math.inf  # of the newest frame
        self._window_end_s = -math.inf
        self._shortest_s = self._previous_shortest_s = math.inf  # of this window and the last one

    def earliest_s(self, time_s: float, now_s: float) -> float:
        """Return the earliest time at which a frame that has just arrived could have arrived.

        ``time_s`` is its media time. ``now_s`` and the result are times of a monotonic clock.
        """
        delay_s = now_s - time_s
        shortest_s = min(self._shortest_s, self._previous_shortest_s)
        if time_s <= self._time_s or delay_s > shortest_s + PAUSE_S:
            self._shortest_s, self._window_end_s = math.inf, -math.inf
        if now_s > self._window_end_s:
            self._previous_shortest_s, self._shortest_s = self._shortest_s, math.inf
            self._window_end_s = now_s + WINDOW_S
        self._time_s = time_s
        self._shortest_s = min(self._shortest_s, delay_s)
        return time_s + min(self._shortest_s, self._previous_shortest_s)
