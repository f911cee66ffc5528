"""Counts and latencies of a service, small enough to travel in every heartbeat."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

WINDOW = 1000  # newest values that percentiles are taken of
PERCENTS = (50, 95, 99)


class Metrics:
    """Counters by name, and percentiles over the newest values of each latency."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._values: dict[str, deque[float]] = {}

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a counter."""
        self._counts[name] += amount

    def observe(self, name: str, value: float) -> None:
        """Take one value of a distribution; the name carries the unit, as in ``chunk_ms``."""
        self._values.setdefault(name, deque(maxlen=WINDOW)).append(value)

    def snapshot(self) -> dict[str, float]:
        """Return the counters, and ``<name>_p50``, ``_p95`` and ``_p99`` of each distribution."""
        result: dict[str, float] = {name: float(value) for name, value in self._counts.items()}
        for name, values in self._values.items():
            for percent, value in zip(PERCENTS, np.percentile(values, PERCENTS), strict=True):
                result[f"{name}_p{percent}"] = float(value)
        return result
