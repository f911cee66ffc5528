"""The gateway's HTTP server: limits connections, closes idle ones, and answers errors.

It replaces aiohttp's ``TCPSite``, which limits neither the number of connections nor the time of a
request.
"""

import asyncio
import errno
import math
import socket
import ssl
import sys
import time
import traceback
from collections.abc import Collection
from typing import Any, cast

from aiohttp import web, web_fileresponse
from aiohttp.http import HttpProcessingError
from aiohttp.typedefs import Handler

from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG, RateLimit
from kouxing.shared.monitoring.metrics import trim_heap

MAX_CONNECTIONS = 256
IDLE_TIMEOUT_S = 10.0  # limit for the wait for the next request
BODY_TIMEOUT_S = 70.0  # limit for the body on unlimited paths; uploads are answered earlier
MAX_HEADER_BYTES = 64 * 1024  # limit for the first line and the headers of a request
ANSWER_TIMEOUT_S = 120.0  # limit for sending a file; a head is 5 MB
BACKLOG = 128
KEEPALIVE_S = 20  # after this time without data, the system probes the client
_KEEPALIVE_PROBES, _PROBE_S = 3, 5
LOG_PERIOD_S = 60.0  # interval between log lines about errors at the same place
_CHECK_S = 1.0
_SHUTDOWN_S = 0.5  # handlers are canceled after this time
_RETRY_S = 1.0  # delay when the system has no free descriptor
# If a connection ends during the system call sendfile, asyncio logs an error.
web_fileresponse.NOSENDFILE = True  # type: ignore[misc]
_HEADERS = {  # sent with every answer
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_OPTIONS: dict[str, Any] = {
    "access_log": None,
    "auto_decompress": False,
    "keepalive_timeout": IDLE_TIMEOUT_S,
    "lingering_time": 0,  # the body of a rejected request is not read
}


def bind_port(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises ``UserError`` if the address is not available; the text names the configuration key.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise UserError(
                f"gateway.port: {port} is in use on {host}; choose another (0: any free port)"
            ) from None
        if error.errno == errno.EACCES:
            raise UserError(f"gateway.port: {port} needs privileges; choose 1024 or more") from None
        raise UserError(
            f"gateway.host: cannot listen on {host!r}: {error.strerror}; "
            "use 127.0.0.1 or an address of this host"
        ) from None


def _enable_keepalive(connection: socket.socket) -> None:
    """Let the system close the connection of a vanished client after 35 s."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    options = (
        ("TCP_KEEPIDLE", KEEPALIVE_S),
        ("TCP_KEEPINTVL", _PROBE_S),
        ("TCP_KEEPCNT", _KEEPALIVE_PROBES),
    )
    for name, value in options:
        if hasattr(socket, name):  # depends on the system
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class _ErrorResponse(web.Response):
    """An answer to a request that did not reach the application; sends no application signals."""

    async def _prepare_headers(self) -> None:
        await super()._prepare_headers()
        await _set_headers(None, self)


class _Connection(web.RequestHandler):
    """One connection. Answers errors that no handler has caught, without a traceback.

    aiohttp limits each of up to 128 headers to 8 KiB, but not their sum, and queues up to 32
    requests. ``data_received`` limits both, for which it reads private members of aiohttp.
    """

    def __init__(self, server: web.Server, address: str, log_limit: RateLimit) -> None:
        super().__init__(server, loop=asyncio.get_running_loop(), **_OPTIONS)
        self.address = address
        self.set_timeout(IDLE_TIMEOUT_S)
        self.request: web.BaseRequest | None = None  # while its handler runs
        self.is_lost = asyncio.Event()
        self._header_bytes = 0
        self._log_limit = log_limit

    def connection_lost(self, exc: BaseException | None) -> None:
        """Mark the connection as lost."""
        super().connection_lost(exc)
        self.is_lost.set()

    def data_received(self, data: bytes) -> None:
        """Handle data; close if a request's head is too long, or too many requests are queued."""
        super().data_received(data)
        is_head = self._waiter is not None and not self._waiter.done()
        self._header_bytes = self._header_bytes + len(data) if is_head else 0
        is_too_long = self._header_bytes > MAX_HEADER_BYTES or len(self._messages) > 1
        if is_too_long and self.transport is not None:
            self.transport.abort()

    async def finish_response(
        self, request: web.BaseRequest, resp: web.StreamResponse, start_time: float | None
    ) -> tuple[web.StreamResponse, bool]:
        """Send an answer. Read the next request only after the client has received the answer."""
        if self.transport is not None:
            self.transport.pause_reading()
        try:
            return await super().finish_response(request, resp, start_time)
        finally:
            if self.transport is not None:  # still connected
                self.transport.resume_reading()

    def set_timeout(self, timeout_s: float) -> None:
        """Close the connection after a timeout; infinite: never close it."""
        self.changed_s = time.monotonic()
        self.deadline_s = self.changed_s + timeout_s

    def on_body_end(self, request: web.BaseRequest) -> None:
        """Remove the time limit of a request once its body is complete."""
        if self.request is request:
            self.set_timeout(math.inf)

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        """Answer a request whose handler raised an exception."""
        if isinstance(exc, ConnectionError):
            raise exc
        if isinstance(exc, HttpProcessingError | web.RequestPayloadError):
            status, text = 400, "this is not a valid HTTP request"
            self._warn("dropped an invalid HTTP request")
        elif isinstance(exc, OSError) and exc.errno == errno.ENAMETOOLONG:
            status, text = 404, "the path is too long"
        elif isinstance(exc, ValueError):
            status, text = 400, "the request contains an invalid value"
            self._warn(f"rejected a request for {request.path[:80]!r}: {exc!r:.200}", exc)
        else:
            text = "internal error; see the log of the service"
            self.log_exception("a request for %r failed", request.path[:80])
        if request.writer.output_size > 0:  # part of an answer has been sent
            raise ConnectionResetError
        response = _ErrorResponse(status=status, text=f"{text}\n")
        response.force_close()
        return response

    def log_exception(self, *args: object, **_options: object) -> None:
        """Log the current exception, once a minute for each place in the code."""
        error = sys.exception()
        if not isinstance(error, ConnectionError) and self._log_limit.allows(_code_location(error)):
            LOG.error(*args, exc_info=True)

    def _warn(self, text: str, error: BaseException | None = None) -> None:
        if self._log_limit.allows(_code_location(error) or text):
            LOG.warning("%s", text)


def _code_location(error: BaseException | None) -> str:
    frames = traceback.extract_tb(error.__traceback__, -1) if error else []
    return "".join(f"{frame.filename}:{frame.lineno}" for frame in frames)


async def _set_headers(_request: web.Request | None, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)
    response.headers.popall("Server", None)  # it contains the versions of Python and aiohttp


class WebServer:
    """Accepts connections and serves them with an aiohttp application.

    ``listener`` is from ``bind_port``. One address gets at most ``address_share`` of the
    connections. If the server is full, a new connection replaces the connection that has been idle
    longest. Connections with a complete request for an unlimited route are never replaced.
    """

    def __init__(
        self, listener: socket.socket, tls: ssl.SSLContext | None, address_share: float
    ) -> None:
        self._listener = listener
        self._tls = tls
        self._max_per_address = math.ceil(address_share * MAX_CONNECTIONS)
        self._connections: dict[_Connection, asyncio.Task[None]] = {}
        self._log_limit = RateLimit(LOG_PERIOD_S)

    async def start(self, application: web.Application, unlimited: Collection[str]) -> None:
        """Start serving an application.

        Handlers of the ``unlimited`` routes, given by their path patterns, have no time limit once
        the whole request has arrived.
        """

        @web.middleware
        async def limit(request: web.Request, handler: Handler) -> web.StreamResponse:
            connection = cast(_Connection, request.protocol)
            connection.request = request
            resource = request.match_info.route.resource
            is_unlimited = resource is not None and resource.canonical in unlimited
            connection.set_timeout(BODY_TIMEOUT_S if is_unlimited else ANSWER_TIMEOUT_S)
            if is_unlimited:
                request.content.on_eof(lambda: connection.on_body_end(request))
            if request.headers.get("Content-Encoding", "identity").lower() != "identity":
                raise web.HTTPUnsupportedMediaType(text="send the body without Content-Encoding\n")
            try:
                return await handler(request)
            finally:
                connection.request = None
                connection.set_timeout(ANSWER_TIMEOUT_S)

        application.middlewares.insert(0, limit)
        application.on_response_prepare.append(_set_headers)
        self._runner = web.AppRunner(application, shutdown_timeout=_SHUTDOWN_S)
        await self._runner.setup()
        self._server = cast(web.Server, self._runner.server)
        self._monitor = asyncio.create_task(self._close_late_connections())
        self._listener.setblocking(False)
        self._start_accepting()

    async def stop(self) -> None:
        """Accept no more connections and close the open ones."""
        asyncio.get_running_loop().remove_reader(self._listener)
        self._listener.close()
        await self._runner.cleanup()
        tasks = [self._monitor, *self._connections.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _start_accepting(self) -> None:
        if self._listener.fileno() >= 0:
            asyncio.get_running_loop().add_reader(self._listener, self._accept)

    def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            accepted, (address, *_) = self._listener.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:
            LOG.error("cannot accept a connection: %s", error.strerror)
            loop.remove_reader(self._listener)
            loop.call_later(_RETRY_S, self._start_accepting)
            return
        if not self._make_room(address):
            accepted.close()
            if self._log_limit.allows("refused"):
                LOG.warning("rejected a connection from %s: too many connections are open", address)
            return
        _enable_keepalive(accepted)
        connection = _Connection(self._server, address, self._log_limit)
        self._connections[connection] = loop.create_task(self._serve(connection, accepted))

    def _make_room(self, address: str) -> bool:
        """Close a connection if the server is full; return False if none may be closed."""
        candidates = [
            connection for connection in self._connections if connection.address == address
        ]
        if len(candidates) < self._max_per_address:
            if len(self._connections) < MAX_CONNECTIONS:
                return True
            candidates = [*self._connections]
        candidates = [connection for connection in candidates if connection.deadline_s < math.inf]
        if candidates:
            closed = min(candidates, key=lambda connection: connection.changed_s)
            self._connections.pop(closed).cancel()
        return bool(candidates)

    async def _close_late_connections(self) -> None:
        num_before = 0
        while True:
            await asyncio.sleep(_CHECK_S)
            if len(self._connections) < num_before:
                trim_heap()  # a client may have queued 20 MiB of audio
            num_before = len(self._connections)
            for connection, task in self._connections.items():
                if time.monotonic() > connection.deadline_s:
                    task.cancel()

    async def _serve(self, connection: _Connection, accepted: socket.socket) -> None:
        """Serve a connection until it is lost or this task is cancelled."""
        transport: asyncio.Transport | None = None
        try:
            transport, _ = await asyncio.get_running_loop().connect_accepted_socket(
                lambda: connection,
                accepted,
                ssl=self._tls,
                ssl_handshake_timeout=IDLE_TIMEOUT_S if self._tls else None,
            )
            await connection.is_lost.wait()
        except OSError:  # a TLS handshake that fails or takes too long
            pass
        finally:
            self._connections.pop(connection, None)
            if transport is not None:
                transport.abort()  # close() would wait for a client that reads nothing
