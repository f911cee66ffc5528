"""Serves the metrics of a service for Prometheus, and its health check, over HTTP.

``/metrics`` has the metrics of ``monitoring.metrics`` under names by Prometheus' conventions;
docs/metrics.md lists them. ``/healthz`` answers 200 while the service's loop runs, and 503 if it
hangs. Neither contains session names, so readers cannot identify speakers.
"""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import ThreadingHTTPServer
from itertools import accumulate

from prometheus_client import CollectorRegistry, MetricsHandler, ProcessCollector
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)

from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.metrics import BUCKETS_MS, Distribution, Metrics

REQUEST_TIMEOUT_S = 5.0  # limit for a peer to send its request and read the answer
MAX_REQUESTS = 16  # concurrent requests; above this, the oldest connection is closed
# Counters with these prefixes become one metric with a label: name, label and help text.
LABELED = {
    "in_": ("messages_received", "kind", "Messages received."),
    "out_": ("messages_published", "kind", "Messages published."),
    "dropped_": ("messages_dropped", "reason", "Messages dropped."),
    "refused_": ("requests_refused", "code", "Requests rejected, by error code."),
    "event_": ("events", "event", "Events published by control."),
}


class MetricsCollector:
    """Converts a service's metrics for prometheus_client. Each has the label ``service``."""

    def __init__(self, metrics: Metrics, service: str) -> None:
        self._metrics = metrics
        self._service = service
        self._process = ProcessCollector(registry=CollectorRegistry())

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics. The service's own thread may change them at the same time."""
        yield from self._counters()
        for name, value in self._metrics.values.copy().items():
            gauge = GaugeMetricFamily(f"kouxing_{name}", "", labels=["service"])
            gauge.add_metric([self._service], value)
            yield gauge
        for name, distribution in self._metrics.distributions.copy().items():
            yield self._histogram(name, distribution)
        for metric in self._process.collect():
            labels = {"service": self._service}
            metric.samples = [sample._replace(labels=labels) for sample in metric.samples]
            yield metric

    def _counters(self) -> Iterator[Metric]:
        labeled = {
            prefix: CounterMetricFamily(f"kouxing_{name}", text, labels=["service", label])
            for prefix, (name, label, text) in LABELED.items()
        }
        for name, value in self._metrics.counts.copy().items():
            prefix = next(filter(name.startswith, labeled), None)
            if prefix is not None:
                label = name.removeprefix(prefix).replace("_", "-")
                labeled[prefix].add_metric([self._service, label], value)
            else:
                base, scale = _unit_and_divisor(name)
                counter = CounterMetricFamily(f"kouxing_{base}", "", labels=["service"])
                counter.add_metric([self._service], value / scale)
                yield counter
        yield from labeled.values()

    def _histogram(self, name: str, distribution: Distribution) -> Metric:
        base, scale = _unit_and_divisor(name)
        limits = [*(str(limit_ms / scale) for limit_ms in BUCKETS_MS), "+Inf"]
        buckets = list(zip(limits, accumulate(distribution.bucket_counts), strict=True))
        histogram = HistogramMetricFamily(f"kouxing_{base}", "", labels=["service"])
        histogram.add_metric([self._service], buckets, distribution.total / scale)
        return histogram


def _unit_and_divisor(name: str) -> tuple[str, float]:
    """Return a metric's name with Prometheus' unit, and the divisor of its values."""
    return (f"{name.removesuffix('_ms')}_seconds", 1e3) if name.endswith("_ms") else (name, 1.0)


class MetricsServer(ThreadingHTTPServer):
    """Serves a service's metrics and health in separate threads.

    prometheus_client's own server has no health check and no limits. ``is_alive`` returns whether
    the service's loop runs; other threads call it. Raises ``UserError`` if the address cannot be
    bound.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(
        self, host: str, port: int, metrics: Metrics, service: str, is_alive: Callable[[], bool]
    ) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.registry = CollectorRegistry()
        self.registry.register(MetricsCollector(metrics, service))
        self.is_alive = is_alive
        self._open: dict[socket.socket, None] = {}  # in the order in which they connected
        try:
            super().__init__((host, port), _Handler)
        except OSError as error:
            raise UserError(
                f"metrics: cannot bind {host} port {port}: {error.strerror}; choose another"
            ) from None
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Stop serving."""
        self.shutdown()
        self.server_close()

    def process_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        """Answer a request in a thread. Close the oldest connection if there are too many."""
        if len(self._open) >= MAX_REQUESTS:
            oldest = next(iter(self._open))
            self._open.pop(oldest)
            with contextlib.suppress(OSError):  # the client has disconnected
                oldest.shutdown(socket.SHUT_RDWR)
        self._open[request] = None
        super().process_request(request, client_address)

    def process_request_thread(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        """Answer a request."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._open.pop(request, None)

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore peers that disconnect."""


class _Handler(MetricsHandler):
    timeout = REQUEST_TIMEOUT_S
    server: MetricsServer

    def send_header(self, keyword: str, value: str) -> None:
        """Send a header, except ``Server``, which contains the version of Python."""
        if keyword != "Server":
            super().send_header(keyword, value)

    def do_GET(self) -> None:  # noqa: N802 - a name of http.server
        if self.path == "/metrics":
            self.registry = self.server.registry
            super().do_GET()
        elif self.path == "/healthz":
            alive = self.server.is_alive()
            status = HTTPStatus.OK if alive else HTTPStatus.SERVICE_UNAVAILABLE
            self._send(status, "alive" if alive else "the loop hangs")
        else:
            self._send(HTTPStatus.NOT_FOUND, "use /metrics or /healthz")

    def _send(self, status: HTTPStatus, text: str) -> None:
        body = f"{text}\n".encode()
        self.send_response(status)
        self.send_header("Content-Type", "text/plain")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
