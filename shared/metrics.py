"""Counts, present values and latencies of a service, small enough to be in every heartbeat.

The same figures are in the heartbeats and on the page for Prometheus (``shared.prometheus``).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import sys
from bisect import bisect_left
from collections import Counter, deque
from pathlib import Path

import numpy as np

WINDOW = 1000  # newest values, of which the percentiles are taken
PERCENTS = (50, 95, 99)
BUCKETS = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)  # upper limits, ms
_ARENA_MAX = -8  # number of this parameter of glibc's mallopt


class Distribution:
    """Values of a latency in ms: the newest ones, and how many there ever were of which size."""

    def __init__(self) -> None:
        self.newest: deque[float] = deque(maxlen=WINDOW)
        self.bucket_counts = [0] * (len(BUCKETS) + 1)  # the last one above all limits
        self.total = 0.0  # of all values

    def add(self, value: float) -> None:
        """Add a value."""
        self.newest.append(value)
        self.bucket_counts[bisect_left(BUCKETS, value)] += 1
        self.total += value


class Metrics:
    """Counters and present values by name, and distributions of latencies.

    Attributes
    ----------
    counts
        What ``count`` has added up, by name.
    values
        What was ``set`` last, by name.
    distributions
        What was observed, by name.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.values: dict[str, float] = {}
        self.distributions: dict[str, Distribution] = {}
        self._last_counts: Counter[str] = Counter()
        self._last_s = 0.0

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a counter."""
        self.counts[name] += amount

    def set(self, name: str, value: float) -> None:
        """Note what a value is now."""
        self.values[name] = value

    def observe(self, name: str, value_ms: float) -> None:
        """Add one value in ms to a distribution; the name carries the unit, as in ``chunk_ms``."""
        if name not in self.distributions:
            self.distributions[name] = Distribution()
        self.distributions[name].add(value_ms)

    def snapshot(self, now_s: float) -> dict[str, float]:
        """Return all figures.

        Each value; each counter, and as ``<name>_per_s`` its rate since the last snapshot;
        ``<name>_p50``, ``_p95`` and ``_p99`` of each distribution's newest values.
        """
        result = dict(self.values)
        passed_s = max(1e-3, now_s - self._last_s)
        for name, value in self.counts.items():
            result[name] = float(value)
            result[f"{name}_per_s"] = (value - self._last_counts[name]) / passed_s
        self._last_s, self._last_counts = now_s, self.counts.copy()
        for name, each in self.distributions.items():
            for percent, value in zip(PERCENTS, np.percentile(each.newest, PERCENTS), strict=True):
                result[f"{name}_p{percent}"] = float(value)
        return result


def memory_mb() -> float:
    """Return the memory that this process takes, in MB of 2^20 bytes.

    Elsewhere than on Linux it is the most that it has taken.
    """
    try:
        pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    except OSError:
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def keep_one_arena() -> None:
    """Let all threads take memory from the same place; to be called before there are others.

    Of the places that glibc makes for further threads, such as ZeroMQ's, ``give_back_memory`` does
    not give back what is free at the end.
    """
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


def give_back_memory() -> None:
    """Give the system what the C library keeps of freed memory; only glibc keeps so much."""
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


class BusyShare:
    """Share of the last seconds in which a loop worked rather than waited for messages.

    Parameters
    ----------
    period_s
        How far it looks back, at least.
    now_s
        The present; the loop does not work yet.
    """

    def __init__(self, period_s: float, now_s: float) -> None:
        self._period_s = period_s
        self._busy_s = 0.0  # in all, up to when it last began to work or to wait
        self._since_s = now_s  # when that was
        self._works = False
        self._marks = deque([(now_s, 0.0)])  # times, and how long it had worked by then

    def works(self, now_s: float) -> None:
        """Note that the loop begins to work."""
        self._since_s, self._works = now_s, True

    def waits(self, now_s: float) -> None:
        """Note that the loop begins to wait."""
        self._busy_s = self._busy_at(now_s)
        self._since_s, self._works = now_s, False

    def share(self, now_s: float) -> float:
        """Return the share, 0 to 1; called every now and then, it looks back to earlier calls."""
        busy_s = self._busy_at(now_s)
        self._marks.append((now_s, busy_s))
        while len(self._marks) > 2 and self._marks[1][0] <= now_s - self._period_s:
            self._marks.popleft()
        then_s, busy_then_s = self._marks[0]
        return min(1.0, (busy_s - busy_then_s) / max(1e-3, now_s - then_s))

    def _busy_at(self, now_s: float) -> float:
        return self._busy_s + (now_s - self._since_s if self._works else 0.0)
