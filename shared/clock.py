"""Media time, clock offsets and stalls.

Media time is a sample index at 16 kHz, never a wall clock. Pauses, drift and the clocks of other
hosts do not affect it. Wall clocks are compared only to report latencies between hosts.
"""

import math
import time
from collections import deque

MEDIA_RATE_HZ = 16_000
CLIENT_CLOCK_RATE = 1.01  # a client's clock may run this much faster
MAX_GAP_S = 10.0  # longer gaps in media time have no frames
MIN_STALL_S = 0.5  # a longer delay is a stall; a busy machine delays a process by less


def to_samples(time_s: float) -> int:
    """Convert seconds to samples of media time; negative times become 0."""
    return max(0, round(time_s * MEDIA_RATE_HZ))


def duration_to_samples(duration_s: float) -> int:
    """Convert a duration, which may be negative, from seconds to samples."""
    return round(duration_s * MEDIA_RATE_HZ)


def to_seconds(samples: int) -> float:
    """Convert samples of media time to seconds."""
    return samples / MEDIA_RATE_HZ


class ClockOffset:
    """Estimates the offset of a remote clock from four timestamps per exchange.

    It uses the recent exchange with the shortest round trip: half of the round trip bounds the
    error (Mills, RFC 5905, section 8).
    """

    def __init__(self) -> None:
        self._exchanges: deque[tuple[int, int]] = deque(maxlen=16)

    def update(self, sent_ns: int, received_ns: int, replied_ns: int, returned_ns: int) -> None:
        """Add one exchange: sent and returned on our clock, received and replied on theirs."""
        round_trip_ns = (returned_ns - sent_ns) - (replied_ns - received_ns)
        offset_ns = ((received_ns - sent_ns) + (replied_ns - returned_ns)) // 2
        self._exchanges.append((round_trip_ns, offset_ns))

    @property
    def offset_ms(self) -> float:
        """Their clock minus ours; 0 before the first exchange."""
        return min(self._exchanges)[1] / 1e6 if self._exchanges else 0.0


def now_ns() -> int:
    """Return the wall clock of this host, ns."""
    return time.time_ns()


class StallDetector:
    """Detects that this process was stopped or starved for longer than a limit.

    All times are in seconds on the same monotonic clock. ``resumed_at_s`` is the end of the latest
    stall; minus infinity before the first.
    """

    def __init__(self, now_s: float, min_stall_s: float = MIN_STALL_S) -> None:
        self.resumed_at_s = -math.inf
        self._min_stall_s = min_stall_s
        self._checked_s = now_s

    def restart(self, now_s: float) -> None:
        """Measure the next pause from now on; the time since the last check was not a stall."""
        self._checked_s = now_s

    def check(self, now_s: float, *, expected_s: float = 0.0) -> float:
        """Return the unexpected part of the time since the last check; 0 without a stall.

        ``expected_s`` is the longest time that the process meant to wait.
        """
        pause_s = now_s - self._checked_s - expected_s
        self._checked_s = now_s
        if pause_s <= self._min_stall_s:
            return 0.0
        self.resumed_at_s = now_s
        return pause_s

    def elapsed_s(self, now_s: float) -> float:
        """Return the time since the last check, up to the limit, because a stall does not count."""
        elapsed_s, self._checked_s = now_s - self._checked_s, now_s
        return min(elapsed_s, self._min_stall_s)
