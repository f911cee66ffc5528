"""Counts and latencies of a service, small enough to be in every heartbeat."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

WINDOW = 1000  # newest values, of which the percentiles are taken
PERCENTS = (50, 95, 99)


class Metrics:
    """Counters by name, and percentiles over the newest values of each latency."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._last_counts: Counter[str] = Counter()
        self._last_s = 0.0
        self._values: dict[str, deque[float]] = {}

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a counter."""
        self._counts[name] += amount

    def observe(self, name: str, value: float) -> None:
        """Add one value to a distribution; the name carries the unit, as in ``chunk_ms``."""
        self._values.setdefault(name, deque(maxlen=WINDOW)).append(value)

    def snapshot(self, now_s: float) -> dict[str, float]:
        """Return all figures.

        Each counter, and as ``<name>_per_s`` its rate since the last snapshot; ``<name>_p50``,
        ``_p95`` and ``_p99`` of each distribution.
        """
        result: dict[str, float] = {}
        passed_s = max(1e-3, now_s - self._last_s)
        for name, value in self._counts.items():
            result[name] = float(value)
            result[f"{name}_per_s"] = (value - self._last_counts[name]) / passed_s
        self._last_s, self._last_counts = now_s, self._counts.copy()
        for name, values in self._values.items():
            for percent, value in zip(PERCENTS, np.percentile(values, PERCENTS), strict=True):
                result[f"{name}_p{percent}"] = float(value)
        return result
