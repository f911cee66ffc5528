"""How late the frames of a live session are sent.

A live client sends audio in real time. The clock minus the media time of a frame is therefore
constant for frames in time, and greater for late frames. The smallest difference so far is that of
a frame in time. It may grow slowly, because the clocks of the client and of this host differ.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

WINDOW_S = 10.0
MAX_CLOCK_DRIFT = 0.01  # as MAX_CLOCK_DRIFT in services/gateway/page/lateness.js


class LatenessMeter:
    """The lateness of one session's newest frames. Times are in seconds."""

    def __init__(self) -> None:
        self._in_time_s = math.inf  # clock minus media time of a frame in time
        self._added_s = 0.0
        self._late_ms: deque[tuple[float, float]] = deque()  # when sent, s; lateness

    def add(self, times_s: Iterable[float], now_s: float) -> None:
        """Record that frames of these media times are sent now."""
        self._in_time_s += MAX_CLOCK_DRIFT * (now_s - self._added_s)
        self._added_s = now_s
        for time_s in times_s:
            self._in_time_s = min(self._in_time_s, now_s - time_s)
            self._late_ms.append((now_s, 1e3 * (now_s - time_s - self._in_time_s)))
        self._drop_old(now_s)

    def pause(self) -> None:
        """Record that the client sends no audio, so that media time stands still."""
        self._in_time_s = math.inf

    def percentiles_ms(self, now_s: float) -> tuple[float, float, float] | None:
        """Return median, 95th percentile and maximum of the last 10 s; None without frames."""
        self._drop_old(now_s)
        if not self._late_ms:
            return None
        late_ms = sorted(value for _, value in self._late_ms)
        p50_ms, p95_ms = (late_ms[int(share * len(late_ms))] for share in (0.5, 0.95))
        return p50_ms, p95_ms, late_ms[-1]

    def _drop_old(self, now_s: float) -> None:
        while self._late_ms and self._late_ms[0][0] <= now_s - WINDOW_S:
            self._late_ms.popleft()
