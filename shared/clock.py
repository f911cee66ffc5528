"""Media time, and the offset between two hosts' clocks.

Media time is a sample index at 16 kHz, never a wall clock: it survives pauses, drift and hosts
whose clocks disagree. Wall clocks are compared only to report latencies between hosts.
"""

from __future__ import annotations

import time
from collections import deque

MEDIA_RATE_HZ = 16_000  # media time counts samples at this rate
MAX_GAP_S = 10.0  # of media time without sound that is filled with frames
STOPPED_S = 0.5  # longer than a busy machine keeps a process waiting


def to_samples(time_s: float) -> int:
    """Return media time in samples for seconds; negative times become 0."""
    return max(0, round(time_s * MEDIA_RATE_HZ))


def duration_to_samples(duration_s: float) -> int:
    """Return a duration in samples for seconds; it may be negative."""
    return round(duration_s * MEDIA_RATE_HZ)


def to_seconds(samples: int) -> float:
    """Return seconds for media time in samples."""
    return samples / MEDIA_RATE_HZ


class ClockOffset:
    """Offset of a remote clock by four-timestamp exchange.

    Of the last exchanges the one with the least round trip counts, since its error is bounded by
    half of that round trip (Mills, RFC 5905, section 8).
    """

    def __init__(self, num_exchanges: int = 16) -> None:
        self._exchanges: deque[tuple[int, int]] = deque(maxlen=num_exchanges)

    def update(self, sent_ns: int, received_ns: int, replied_ns: int, returned_ns: int) -> None:
        """Take one exchange: sent and returned by our clock, received and replied by theirs."""
        round_trip_ns = (returned_ns - sent_ns) - (replied_ns - received_ns)
        offset_ns = ((received_ns - sent_ns) + (replied_ns - returned_ns)) // 2
        self._exchanges.append((round_trip_ns, offset_ns))

    @property
    def offset_ms(self) -> float:
        """Their clock minus ours, 0 before the first exchange."""
        return min(self._exchanges)[1] / 1e6 if self._exchanges else 0.0


def now_ns() -> int:
    """Return this host's wall clock."""
    return time.time_ns()


def was_stopped(begin_s: float, timeout_s: float) -> bool:
    """Return whether a wait, which ends now, took so long that the process was stopped meanwhile.

    Parameters
    ----------
    begin_s
        When it began, by ``time.monotonic``.
    timeout_s
        How long it was to take at most.
    """
    return time.monotonic() > begin_s + timeout_s + STOPPED_S
