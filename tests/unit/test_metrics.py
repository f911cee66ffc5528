"""Snapshots of metrics, their page for Prometheus, and the busy load of a loop."""

from collections.abc import Iterable

import numpy as np
import pytest

from kouxing.shared.fast_record import replace
from kouxing.shared.monitoring.metrics import NUM_NEWEST, LoadMeter, Metrics, percentile
from kouxing.shared.wire.codec import decode, encode
from kouxing.shared.wire.control import EventName
from kouxing.shared.wire.kinds import MESSAGES
from kouxing.shared.wire.session import ErrorCode
from tests.samples import SAMPLES


def test_a_snapshot_has_counts_percentiles_and_rates() -> None:
    metrics = Metrics()
    metrics.count("in_audio")
    metrics.count("in_audio", 2)
    for value_ms in [1e9] * 10 + [*range(101)] * (NUM_NEWEST // 100):  # the first ones are too old
        metrics.observe("chunk_ms", float(value_ms))
    snapshot = metrics.snapshot(0.0)
    assert snapshot["in_audio"] == 3
    assert snapshot["chunk_ms_p50"] == pytest.approx(50.0, abs=1.0)
    assert snapshot["chunk_ms_p99"] <= 100.0
    metrics.count("frames", 100)
    metrics.snapshot(10.0)
    metrics.count("frames", 25)
    assert metrics.snapshot(10.5)["frames_per_s"] == 50.0
    assert metrics.snapshot(11.0)["frames_per_s"] == 0.0


def test_a_heartbeat_with_every_counter_is_readable() -> None:
    metrics = Metrics()
    names_by_prefix: dict[str, Iterable[str]] = {
        "in": MESSAGES,
        "out": MESSAGES,
        "dropped": ErrorCode,
        "event": EventName,
        "refused": ErrorCode,
    }
    for prefix, names in names_by_prefix.items():
        for name in names:
            metrics.count(f"{prefix}_{name}")
    heartbeat = replace(SAMPLES["heartbeat"], metrics=metrics.snapshot(0.0))
    assert decode(encode(heartbeat)) == heartbeat


def busy_load(until_s: float, work_s: float) -> LoadMeter:
    """Return the load of a loop that works at the start of each second, read every 0.25 s."""
    busy = LoadMeter(2.0, 0.0)
    for quarter in range(int(4 * until_s)):
        if quarter % 4 == 0:
            busy.start_working(quarter / 4)
            busy.start_waiting(quarter / 4 + work_s)
        busy.load(quarter / 4 + 0.25)
    return busy


@pytest.mark.parametrize("work_s", [0.0, 0.1, 0.25])
def test_the_busy_load_is_that_of_the_work(work_s: float) -> None:
    assert busy_load(6.0, work_s).load(6.0) == pytest.approx(work_s, abs=0.03)


def test_the_busy_load_forgets_old_work_and_includes_work_in_progress() -> None:
    busy = busy_load(4.0, 0.2)
    for quarter in range(1, 13):
        last = busy.load(4.0 + quarter / 4)
    assert last == 0.0
    busy.start_working(7.0)
    assert busy.load(9.0) == 1.0


@pytest.mark.parametrize(("added_s", "load"), [(-0.4, 0.2), (0.1, 0.7), (9.0, 1.0)])
def test_the_busy_load_includes_added_work(added_s: float, load: float) -> None:
    busy = LoadMeter(2.0, 0.0)
    busy.start_working(0.0)
    busy.start_waiting(0.6)
    busy.add(added_s)
    assert busy.load(1.0) == pytest.approx(load)


@pytest.mark.parametrize("values", [[7.0], [1.0, 100.0], [*range(10)], [0.5, 0.7, 3.0]])
@pytest.mark.parametrize("percent", [1, 50, 95, 100])
def test_percentiles_equal_numpys(values: list[float], percent: int) -> None:
    assert percentile(values, percent) == pytest.approx(np.percentile(values, percent))
