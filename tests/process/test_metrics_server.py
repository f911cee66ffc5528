"""The HTTP server of metrics and health: its answers and its limits."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.metrics import Metrics
from kouxing.shared.prometheus import MAX_REQUESTS, MetricsServer


@pytest.fixture
def server() -> Iterator[MetricsServer]:
    with closing(start()) as server:
        yield server


def start(port: int = 0) -> MetricsServer:
    metrics = Metrics()
    metrics.count("resent", 5)
    return MetricsServer("127.0.0.1", port, metrics, "tester", lambda: True)


def get(server: MetricsServer, path: str) -> str:
    address = f"http://127.0.0.1:{server.server_port}{path}"
    with urllib.request.urlopen(address, timeout=30) as page:
        text: str = page.read().decode()
        return text


def test_serves_metrics_and_health(server: MetricsServer) -> None:
    assert 'kouxing_resent_total{service="tester"} 5.0' in get(server, "/metrics")
    assert get(server, "/healthz") == "alive\n"
    server.is_alive = lambda: False
    with pytest.raises(urllib.error.HTTPError, match="503"):
        get(server, "/healthz")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        get(server, "/")


def test_closes_connections_beyond_the_limit(server: MetricsServer) -> None:
    address = ("127.0.0.1", server.server_port)
    with ExitStack() as connections:
        for _ in range(MAX_REQUESTS):
            connections.enter_context(socket.create_connection(address))
        with closing(socket.create_connection(address, timeout=30)) as refused:
            assert refused.recv(1) == b""


def test_a_port_in_use_is_an_error_that_names_it(server: MetricsServer) -> None:
    port = server.server_port
    with pytest.raises(UserError, match=f"metrics_port: cannot bind 127.0.0.1 port {port}"):
        start(port)
