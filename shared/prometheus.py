"""A service's figures for Prometheus, and whether it is alive, over HTTP.

``/metrics`` has what ``shared.metrics`` counts, in Prometheus' text format, under names by its
conventions; docs/metrics.md lists them. ``/healthz`` answers 200 while the service's loop runs and
503 when it hangs. No session is named, so whoever may read this learns nothing of who speaks.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import accumulate

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from kouxing.shared.errors import UserError
from kouxing.shared.metrics import BUCKETS, Distribution, Metrics

REQUEST_LIMIT_S = 5.0  # for a peer to send its request and take the answer
MAX_REQUESTS = 16  # answered at the same time; further connections are closed
# Counters whose names begin so are one metric with a label: its name, its label, what it counts.
LABELLED = {
    "in_": ("messages_received", "kind", "Messages received."),
    "out_": ("messages_published", "kind", "Messages published."),
    "dropped_": ("messages_dropped", "reason", "Messages dropped."),
    "refused_": ("requests_refused", "code", "Requests refused, by code of the error."),
    "event_": ("events", "event", "Events published by control."),
}


class MetricsCollector:
    """Gives Prometheus' client a service's figures, each with the label ``service``."""

    def __init__(self, metrics: Metrics, service: str) -> None:
        self._metrics = metrics
        self._service = service
        self._process = ProcessCollector(registry=CollectorRegistry())

    def collect(self) -> Iterator[Metric]:
        """Yield all figures; called in another thread than those that count."""
        yield from self._counters()
        for name, value in self._metrics.values.copy().items():
            gauge = GaugeMetricFamily(f"kouxing_{name}", "", labels=["service"])
            gauge.add_metric([self._service], value)
            yield gauge
        for name, each in self._metrics.distributions.copy().items():
            yield self._histogram(name, each)
        for metric in self._process.collect():
            metric.samples = [
                sample._replace(labels={"service": self._service}) for sample in metric.samples
            ]
            yield metric

    def _counters(self) -> Iterator[Metric]:
        labelled = {
            prefix: CounterMetricFamily(f"kouxing_{name}", text, labels=["service", label])
            for prefix, (name, label, text) in LABELLED.items()
        }
        for name, value in self._metrics.counts.copy().items():
            for prefix, counter in labelled.items():
                if name.startswith(prefix):
                    label = name.removeprefix(prefix).replace("_", "-")
                    counter.add_metric([self._service, label], value)
                    break
            else:
                counter = CounterMetricFamily(f"kouxing_{_base(name)}", "", labels=["service"])
                counter.add_metric([self._service], value / 1e3 if name != _base(name) else value)
                yield counter
        yield from labelled.values()

    def _histogram(self, name: str, each: Distribution) -> Metric:
        limits = [*(str(limit_ms / 1e3) for limit_ms in BUCKETS), "+Inf"]
        histogram = HistogramMetricFamily(f"kouxing_{_base(name)}", "", labels=["service"])
        counts = accumulate(each.bucket_counts)
        histogram.add_metric(
            [self._service], list(zip(limits, counts, strict=True)), each.total / 1e3
        )
        return histogram


def _base(name: str) -> str:
    """Return a name with Prometheus' unit: seconds where it is ms."""
    return f"{name.removesuffix('_ms')}_seconds" if name.endswith("_ms") else name


class MetricsServer:
    """Serves a service's figures and its health, in threads of its own.

    Parameters
    ----------
    host, port
        Where.
    metrics
        The figures.
    service
        Their label.
    is_alive
        Whether the service's loop runs; called in another thread.

    Raises
    ------
    UserError
        If the address cannot be bound.
    """

    def __init__(
        self, host: str, port: int, metrics: Metrics, service: str, is_alive: Callable[[], bool]
    ) -> None:
        registry = CollectorRegistry()
        registry.register(MetricsCollector(metrics, service))

        class Handler(BaseHTTPRequestHandler):
            timeout = REQUEST_LIMIT_S

            def do_GET(self) -> None:
                if self.path == "/metrics":
                    self._answer(HTTPStatus.OK, generate_latest(registry), CONTENT_TYPE_PLAIN_0_0_4)
                elif self.path == "/healthz":
                    alive = is_alive()
                    status = HTTPStatus.OK if alive else HTTPStatus.SERVICE_UNAVAILABLE
                    self._answer(status, b"alive\n" if alive else b"the loop hangs\n")
                else:
                    self._answer(HTTPStatus.NOT_FOUND, b"there are /metrics and /healthz\n")

            def _answer(
                self, status: HTTPStatus, body: bytes, content_type: str = "text/plain"
            ) -> None:
                self.send_response(status)
                self.send_header("Content-Type", content_type)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_arguments: object) -> None:
                """Leave requests out of the log."""

        try:
            self._server = _Server(host, port, Handler)
        except OSError as error:
            raise UserError(
                f"metrics_port: cannot bind {host} port {port}: {error.strerror}"
            ) from None
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def port(self) -> int:
        """The port that was bound."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, host: str, port: int, handler: type[BaseHTTPRequestHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._free = threading.BoundedSemaphore(MAX_REQUESTS)
        super().__init__((host, port), handler)

    def process_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing about peers that go away."""
