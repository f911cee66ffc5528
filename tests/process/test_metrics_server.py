"""The HTTP server of metrics and health: its answers and its limits."""

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


def test_answers_while_too_many_connections_send_no_request(server: MetricsServer) -> None:
    address = ("127.0.0.1", server.server_port)
    with ExitStack() as connections:
        for _ in range(MAX_REQUESTS + 1):
            connection = socket.create_connection(address, timeout=30)
            connections.enter_context(connection).sendall(b"GET /metr")
        assert get(server, "/healthz") == "alive\n"


@pytest.mark.parametrize("request_line", [b"GET /healthz HTTP/1.1", b"\xff\xff / HTTP/9"])
def test_sends_no_version(server: MetricsServer, request_line: bytes) -> None:
    with closing(socket.create_connection(("127.0.0.1", server.server_port), 30)) as client:
        client.sendall(request_line + b"\r\n\r\n")
        answer = client.makefile("rb").read()
    assert answer
    assert b"Server:" not in answer
    assert b"Python" not in answer


def test_a_port_in_use_is_an_error_that_names_it(server: MetricsServer) -> None:
    port = server.server_port
    with pytest.raises(UserError, match=f"metrics_port: cannot bind 127.0.0.1 port {port}"):
        start(port)
