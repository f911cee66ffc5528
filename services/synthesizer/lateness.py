"""Measures the lateness of the frames of a live session.

A live client sends audio in real time. The clock minus the media time of a frame is therefore
constant for frames in time, and greater for late frames. Frames are compared with the earliest one
of the last 10 s. Older frames are useless for this, because clocks drift and a client may lose
audio.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from kouxing.shared.metrics import percentile

WINDOW_S = 10.0  # as in services/gateway/page/lateness.js


class LatenessMeter:
    """Measures the lateness of one session's newest frames. Times are in seconds."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, float]] = deque()  # when sent; clock minus media time

    def add(self, times_s: Iterable[float], now_s: float) -> None:
        """Record that frames with these media times are sent now."""
        self._sent.extend((now_s, now_s - time_s) for time_s in times_s)
        self._drop_old(now_s)

    def pause(self) -> None:
        """Record that the client sends no audio, so that media time stands still."""
        self._sent.clear()

    def percentiles_ms(self, now_s: float) -> tuple[float, float, float] | None:
        """Return the median, 95th percentile and maximum of the last 10 s, None without frames."""
        self._drop_old(now_s)
        differences_s = sorted(difference_s for _, difference_s in self._sent)
        if not differences_s:
            return None
        p50_s, p95_s, latest_s = (percentile(differences_s, percent) for percent in (50, 95, 100))
        earliest_s = differences_s[0]
        return 1e3 * (p50_s - earliest_s), 1e3 * (p95_s - earliest_s), 1e3 * (latest_s - earliest_s)

    def _drop_old(self, now_s: float) -> None:
        while self._sent and self._sent[0][0] <= now_s - WINDOW_S:
            self._sent.popleft()
