"""Metrics and health over HTTP: the server's limits, the documents and the dashboard."""

import json
import re
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest
from kouxing_client import Client, FapFrame
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.metrics import Metrics
from kouxing.shared.monitoring.prometheus import MAX_REQUESTS, MetricsServer
from kouxing.shared.settings.config import variable_name
from tests.raw_bytes import flood
from tests.system import CHAIN, LIMIT_S, ROOT, VOWELS_FILE, System, free_port


@pytest.fixture
def server() -> Iterator[MetricsServer]:
    with closing(start()) as server:
        yield server


def start(port: int = 0) -> MetricsServer:
    metrics = Metrics()
    metrics.count("resent", 5)
    return MetricsServer("127.0.0.1", port, metrics, "tester", lambda: True)


def get(port: int, path: str) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=LIMIT_S) as page:
        text: str = page.read().decode()
        return text


def test_the_server_has_metrics_and_health(server: MetricsServer) -> None:
    assert 'kouxing_resent_total{service="tester"} 5.0' in get(server.server_port, "/metrics")
    assert get(server.server_port, "/healthz") == "alive\n"
    server.is_alive = lambda: False
    with pytest.raises(urllib.error.HTTPError, match="503"):
        get(server.server_port, "/healthz")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        get(server.server_port, "/")


def test_answers_while_too_many_connections_send_no_request(server: MetricsServer) -> None:
    address = ("127.0.0.1", server.server_port)
    with ExitStack() as connections:
        for _ in range(MAX_REQUESTS + 1):
            connection = socket.create_connection(address, timeout=LIMIT_S)
            connections.enter_context(connection).sendall(b"GET /metr")
        assert get(server.server_port, "/healthz") == "alive\n"


@pytest.mark.parametrize("request_line", [b"GET /healthz HTTP/1.1", b"\xff\xff / HTTP/9"])
def test_answers_have_no_version(server: MetricsServer, request_line: bytes) -> None:
    with closing(socket.create_connection(("127.0.0.1", server.server_port), LIMIT_S)) as client:
        client.sendall(request_line + b"\r\n\r\n")
        answer = client.makefile("rb").read()
    assert answer
    assert b"Server:" not in answer
    assert b"Python" not in answer


def test_a_port_in_use_is_an_error_that_names_it(server: MetricsServer) -> None:
    port = server.server_port
    with pytest.raises(UserError, match=f"metrics: cannot bind 127.0.0.1 port {port}"):
        start(port)


ELSEWHERE = {  # metrics of other services, or of what does not happen here
    *("frames_missed", "videos", "video_seconds", "repeated", "other_epoch", "too_early"),
    "skipped_audio_seconds",
}
SUFFIXES = ("_total", "_bucket", "_count", "_sum")


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    settings = {variable_name(name, "metrics"): f"127.0.0.1:{free_port()}" for name in CHAIN}
    with System(CHAIN, tmp_path_factory.mktemp("system"), settings) as running:
        yield running


@pytest.fixture(scope="module")
def families(system: System) -> dict[str, list[Metric]]:
    """Metrics of each service while a session is open."""
    ports = [
        int(system.environment[variable_name(name, "metrics")].rpartition(":")[2]) for name in CHAIN
    ]
    with Client(system.control) as client:
        samples, rate_hz = read_audio(VOWELS_FILE)
        session = client.open_session(encoding="f32le", sample_rate_hz=rate_hz)
        output = session.results(FapFrame, keep_all=True)
        session.push(samples)
        session.finish()
        assert list(output)
        before = _heartbeats(client)
        system.wait_until(lambda _: _heartbeats(client) > before + 5)  # they set the gauges
        for port in ports:
            flood(port, 0.2)  # which the pages outlast
        pages = [[*text_string_to_metric_families(get(port, "/metrics"))] for port in ports]
    return dict(zip(CHAIN, pages, strict=True))


def _heartbeats(client: Client) -> float:
    (control,) = (state for state in client.status().services if state.service == "control")
    return control.metrics.get("in_heartbeat", 0.0)  # control's own heartbeat has them


def _names(families: dict[str, list[Metric]]) -> set[str]:
    return {family.name for item in families.values() for family in item}


def test_every_metric_is_documented(families: dict[str, list[Metric]]) -> None:
    page = (ROOT / "docs" / "metrics.md").read_text("utf-8")
    documented = {
        re.sub("_total$", "", name) for name in re.findall(r"`((?:kouxing|process)_\w+)`", page)
    }
    elsewhere = {f"kouxing_{name}" for name in ELSEWHERE}
    assert documented == {re.sub("_total$", "", name) for name in _names(families)} | elsewhere


def test_the_dashboard_uses_only_known_metrics(families: dict[str, list[Metric]]) -> None:
    dashboard = json.loads((ROOT / "deploy" / "grafana.json").read_text("utf-8"))
    served = {name for item in families.values() for family in item for name in _forms(family)}
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            names = re.findall(r"\b(?:kouxing|process)_\w+", target["expr"])
            assert names, panel["title"]
            assert set(names) <= served, panel["title"]


def _forms(family: Metric) -> set[str]:
    suffixes = {"counter": SUFFIXES[:1], "histogram": SUFFIXES[1:], "gauge": ("",)}
    return {f"{family.name}{suffix}" for suffix in suffixes[family.type]}
