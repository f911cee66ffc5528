"""Names and values of a service's metrics for Prometheus."""

from __future__ import annotations

import pytest
from prometheus_client import CollectorRegistry

from kouxing.shared.metrics import Metrics
from kouxing.shared.prometheus import MetricsCollector

pytestmark = pytest.mark.unit


class Page:
    def __init__(self) -> None:
        self.metrics = Metrics()
        self._registry = CollectorRegistry()
        self._registry.register(MetricsCollector(self.metrics, "tester"))

    def value(self, name: str, **labels: str) -> float | None:
        return self._registry.get_sample_value(name, {"service": "tester", **labels})


def test_counters_become_metrics_with_labels() -> None:
    page = Page()
    page.metrics.count("in_audio_chunk", 3)
    page.metrics.count("dropped_bad-audio")
    page.metrics.count("dropped_old_epoch", 2)
    page.metrics.count("resent", 5)
    page.metrics.count("video_ms", 1500)
    assert page.value("kouxing_messages_received_total", kind="audio-chunk") == 3
    assert page.value("kouxing_messages_dropped_total", reason="bad-audio") == 1
    assert page.value("kouxing_messages_dropped_total", reason="old-epoch") == 2
    assert page.value("kouxing_resent_total") == 5
    assert page.value("kouxing_video_seconds_total") == 1.5


def test_a_gauge_has_its_last_value_as_in_heartbeats() -> None:
    page = Page()
    for number in (4, 7):
        page.metrics.set("sessions", number)
    assert page.value("kouxing_sessions") == 7 == page.metrics.snapshot(0.0)["sessions"]


def test_latencies_become_histograms_in_seconds() -> None:
    page = Page()
    for value_ms in (0.4, 5.0, 5.1, 60_000.0):
        page.metrics.observe("chunk_ms", value_ms)
    limits = ("0.0005", "0.005", "0.01", "5.0", "+Inf")
    counts = [page.value("kouxing_chunk_seconds_bucket", le=limit) for limit in limits]
    assert counts == [1, 2, 3, 3, 4]
    assert page.value("kouxing_chunk_seconds_count") == 4
    assert page.value("kouxing_chunk_seconds_sum") == pytest.approx(60.0105)


def test_metrics_of_the_process_have_the_same_label() -> None:
    assert (Page().value("process_cpu_seconds_total") or 0) > 0
    assert (Page().value("process_resident_memory_bytes") or 0) > 2**20
