"""Counters, gauges and latencies of a service, compact enough for every heartbeat.

Heartbeats and the Prometheus page (``monitoring.prometheus``) have the same values.
"""

import contextlib
import ctypes
import os
import resource
import sys
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path

NUM_NEWEST = 1000  # values that percentiles are computed from
PERCENTS = (50, 95, 99)
BUCKETS_MS = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)  # upper limits
_STATM = Path("/proc/self/statm")
LOAD_PERIOD_S = 2.0  # a service measures its load over this time
_ARENA_MAX = -8  # glibc's M_ARENA_MAX, a parameter of mallopt


class Distribution:
    """Values of a latency in ms: the newest values, and a histogram of all values."""

    def __init__(self) -> None:
        self.newest: deque[float] = deque(maxlen=NUM_NEWEST)
        self.bucket_counts = [0] * (len(BUCKETS_MS) + 1)  # the last bucket has no upper limit
        self.total = 0.0

    def add(self, value_ms: float) -> None:
        """Add a value."""
        self.newest.append(value_ms)
        self.bucket_counts[bisect_left(BUCKETS_MS, value_ms)] += 1
        self.total += value_ms


class Metrics:
    """Counters, gauges (``values``) and latencies (``distributions``) of a service by name."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.values: dict[str, float] = {}
        self.distributions: dict[str, Distribution] = {}
        self._last_counts: Counter[str] = Counter()
        self._last_s = 0.0

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a counter."""
        self.counts[name] += amount

    def observe(self, name: str, value_ms: float) -> None:
        """Add a value to a latency. Its name has the unit, for example ``chunk_ms``."""
        if name not in self.distributions:
            self.distributions[name] = Distribution()
        self.distributions[name].add(value_ms)

    def snapshot(self, now_s: float) -> dict[str, float]:
        """Return all metrics.

        A counter also has its rate since the last snapshot, as ``<name>_per_s``. A latency has the
        percentiles of its newest values, as ``<name>_p50``, ``_p95`` and ``_p99``.
        """
        result = dict(self.values)
        passed_s = max(1e-3, now_s - self._last_s)
        for name, value in self.counts.items():
            result[name] = float(value)
            result[f"{name}_per_s"] = (value - self._last_counts[name]) / passed_s
        self._last_s, self._last_counts = now_s, self.counts.copy()
        for name, latency in self.distributions.items():
            ordered = sorted(latency.newest)
            for percent in PERCENTS:
                result[f"{name}_p{percent}"] = percentile(ordered, percent)
        return result


def percentile(ordered: Sequence[float], percent: int) -> float:
    """Return a percentile of sorted, non-empty values, interpolated between the nearest two.

    ``statistics.quantiles`` is not used, because it rejects a single value before Python 3.13.
    """
    index, hundredths = divmod(percent * (len(ordered) - 1), 100)
    lower, upper = ordered[index], ordered[min(index + 1, len(ordered) - 1)]
    return lower + hundredths / 100 * (upper - lower)


def memory_mb() -> float:
    """Return the memory of this process in MiB; on systems other than Linux, its maximum so far."""
    try:
        pages = int(_STATM.read_text("ascii").split()[1])
    except OSError:
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def use_single_malloc_arena() -> None:
    """Let all threads share one glibc arena. Call this before starting threads.

    ``trim_heap`` cannot release memory at the end of additional arenas, such as the arenas of
    ZeroMQ's threads.
    """
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


def trim_heap() -> None:
    """Return freed memory to the system. Only glibc keeps a relevant amount."""
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


class LoadMeter:
    """Measures the fraction of at least the last ``period_s`` in which a loop worked."""

    def __init__(self, period_s: float, now_s: float) -> None:
        self._period_s = period_s
        self._busy_s = 0.0  # total, up to the last change between work and waiting
        self._changed_s = now_s
        self._works = False
        self._marks = deque([(now_s, 0.0)])  # times, and the total of working time until then

    def start_working(self, now_s: float) -> None:
        """Record that the loop starts to work."""
        self._changed_s, self._works = now_s, True

    def start_waiting(self, now_s: float) -> None:
        """Record that the loop starts to wait."""
        self._busy_s = self._busy_at(now_s)
        self._changed_s, self._works = now_s, False

    def add(self, duration_s: float) -> None:
        """Add work of another thread. A negative time reduces the loop's work."""
        self._busy_s += duration_s

    def load(self, now_s: float) -> float:
        """Return the fraction of working time since an earlier call, 0 to 1. Call it regularly."""
        busy_s = self._busy_at(now_s)
        self._marks.append((now_s, busy_s))
        while len(self._marks) > 2 and self._marks[1][0] <= now_s - self._period_s:
            self._marks.popleft()
        then_s, busy_then_s = self._marks[0]
        return min(1.0, max(0.0, busy_s - busy_then_s) / max(1e-3, now_s - then_s))

    def _busy_at(self, now_s: float) -> float:
        return self._busy_s + (now_s - self._changed_s if self._works else 0.0)
