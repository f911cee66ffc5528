from __future__ import annotations

import pytest

from shared.metrics import WINDOW, Metrics

pytestmark = pytest.mark.unit


def test_counts_and_percentiles() -> None:
    metrics = Metrics()
    metrics.count("in_audio")
    metrics.count("in_audio", 2)
    for value in range(101):
        metrics.observe("chunk_ms", float(value))
    snapshot = metrics.snapshot(0.0)
    assert snapshot["in_audio"] == 3
    assert (snapshot["chunk_ms_p50"], snapshot["chunk_ms_p95"]) == (50.0, 95.0)


def test_only_the_newest_values_count() -> None:
    metrics = Metrics()
    for value in [1e9] * 10 + [1.0] * WINDOW:
        metrics.observe("chunk_ms", value)
    assert metrics.snapshot(0.0)["chunk_ms_p99"] == 1.0


def test_rates_are_taken_between_snapshots() -> None:
    metrics = Metrics()
    metrics.count("frames", 100)
    metrics.snapshot(10.0)
    metrics.count("frames", 25)
    assert metrics.snapshot(10.5)["frames_per_s"] == 50.0
    assert metrics.snapshot(11.0)["frames_per_s"] == 0.0
