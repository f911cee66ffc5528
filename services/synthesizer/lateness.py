"""Measures the lateness of the frames of a live session.

A live client sends audio in real time. Therefore, the clock minus the media time is constant for
frames that are on time, and greater for late frames. Frames are compared with the earliest one of
the last 10 s. Older frames are not comparable, because clocks drift and a client may lose audio.
"""

from collections import deque
from collections.abc import Iterable

from kouxing_client.messages import Lateness

from kouxing.shared.monitoring.metrics import percentile

NO_LATENESS = Lateness(p50_ms=0.0, p95_ms=0.0, worst_ms=0.0)
WINDOW_S = 10.0  # as in services/gateway/page/lateness.js


class LatenessMeter:
    """Measures the lateness of one session's newest frames. Times are in seconds."""

    def __init__(self) -> None:
        self.newest: Lateness | None = None  # the newest measurement
        self._sent: deque[tuple[float, float]] = deque()  # when sent; clock minus media time

    def add(self, times_s: Iterable[float], now_s: float) -> None:
        """Record that frames with these media times are sent now."""
        self._sent.extend((now_s, now_s - time_s) for time_s in times_s)
        self._drop_old(now_s)

    def pause(self) -> None:
        """Record that the client sends no audio, so that media time does not advance."""
        self._sent.clear()

    def measure(self, now_s: float) -> Lateness | None:
        """Return the lateness of the last 10 s, or None without frames. Store it in ``newest``."""
        self._drop_old(now_s)
        self.newest = None
        differences_s = sorted([difference_s for _, difference_s in self._sent])
        if differences_s:
            p50_ms, p95_ms, worst_ms = (
                1e3 * (percentile(differences_s, percent) - differences_s[0])
                for percent in (50, 95, 100)
            )
            self.newest = Lateness(p50_ms=p50_ms, p95_ms=p95_ms, worst_ms=worst_ms)
        return self.newest

    def _drop_old(self, now_s: float) -> None:
        while self._sent and self._sent[0][0] <= now_s - WINDOW_S:
            self._sent.popleft()
