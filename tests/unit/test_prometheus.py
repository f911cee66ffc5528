"""The page for Prometheus: names and values of what a service counts, and its health."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing

import pytest
from prometheus_client.parser import text_string_to_metric_families

from kouxing.shared.errors import UserError
from kouxing.shared.metrics import Metrics
from kouxing.shared.prometheus import MAX_REQUESTS, MetricsServer

pytestmark = pytest.mark.unit


class Page:
    def __init__(self) -> None:
        self.metrics = Metrics()
        self.alive = True
        self.server = MetricsServer("127.0.0.1", 0, self.metrics, "tester", lambda: self.alive)

    def get(self, path: str) -> str:
        with urllib.request.urlopen(
            f"http://127.0.0.1:{self.server.port}{path}", timeout=10
        ) as page:
            text: str = page.read().decode()
            return text

    def samples(self) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
        return {
            (sample.name, frozenset(sample.labels.items())): sample.value
            for family in text_string_to_metric_families(self.get("/metrics"))
            for sample in family.samples
        }

    def value(self, name: str, **labels: str) -> float:
        return self.samples()[name, frozenset({"service": "tester", **labels}.items())]


@pytest.fixture
def page() -> Iterator[Page]:
    page = Page()
    yield page
    page.server.close()


def test_counters_become_metrics_with_labels(page: Page) -> None:
    page.metrics.count("in_audio_chunk", 3)
    page.metrics.count("dropped_bad-audio")
    page.metrics.count("dropped_old_epoch", 2)
    page.metrics.count("event_session-moved")
    page.metrics.count("resent", 5)
    page.metrics.count("video_ms", 1500)
    assert page.value("kouxing_messages_received_total", kind="audio-chunk") == 3
    assert page.value("kouxing_messages_dropped_total", reason="bad-audio") == 1
    assert page.value("kouxing_messages_dropped_total", reason="old-epoch") == 2
    assert page.value("kouxing_events_total", event="session-moved") == 1
    assert page.value("kouxing_resent_total") == 5
    assert page.value("kouxing_video_seconds_total") == 1.5


def test_values_are_the_last_ones(page: Page) -> None:
    for number in (4, 7):
        page.metrics.set("sessions", number)
    assert page.value("kouxing_sessions") == 7
    assert page.metrics.snapshot(0.0)["sessions"] == 7, "heartbeats have the same"


def test_latencies_become_histograms_in_seconds(page: Page) -> None:
    for value_ms in (0.4, 5.0, 5.1, 60_000.0):
        page.metrics.observe("chunk_ms", value_ms)
    counts = {
        limit: page.value("kouxing_chunk_seconds_bucket", le=limit)
        for limit in ("0.0005", "0.005", "0.01", "5.0", "+Inf")
    }
    assert list(counts.values()) == [1, 2, 3, 3, 4]
    assert page.value("kouxing_chunk_seconds_count") == 4
    assert page.value("kouxing_chunk_seconds_sum") == pytest.approx(60.0105)


def test_the_process_is_measured_under_the_same_label(page: Page) -> None:
    assert page.value("process_cpu_seconds_total") > 0
    assert page.value("process_resident_memory_bytes") > 2**20


def test_health_is_that_of_the_loop(page: Page) -> None:
    assert page.get("/healthz") == "alive\n"
    page.alive = False
    with pytest.raises(urllib.error.HTTPError, match="503"):
        page.get("/healthz")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        page.get("/")


def test_peers_that_say_nothing_take_no_more_than_their_places(page: Page) -> None:
    address = ("127.0.0.1", page.server.port)
    silent = [socket.create_connection(address) for _ in range(MAX_REQUESTS)]
    with closing(socket.create_connection(address, timeout=10)) as refused:
        assert refused.recv(1) == b""
    for connection in silent:
        connection.close()


def test_a_port_that_is_taken_is_named(page: Page) -> None:
    with pytest.raises(
        UserError, match=f"metrics_port: cannot bind 127.0.0.1 port {page.server.port}"
    ):
        MetricsServer("127.0.0.1", page.server.port, Metrics(), "tester", lambda: True)
