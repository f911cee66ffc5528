"""The gateway's HTTP server: it limits connections and closes those that are idle."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import math
import socket
import ssl
import time
from collections.abc import Callable, Collection
from typing import cast

from aiohttp import web
from aiohttp.http import HttpProcessingError
from aiohttp.typedefs import Handler

from kouxing.services.gateway.config import ADDRESS_SHARE
from kouxing.services.gateway.limits import ConnectionQuota
from kouxing.shared.errors import UserError
from kouxing.shared.logs import LOG

MAX_CONNECTIONS = 256
IDLE_TIMEOUT_S = 10.0  # until a request arrives, and until the next one
BODY_TIMEOUT_S = 70.0  # for the body on unlimited paths; an upload is answered before that
ANSWER_TIMEOUT_S = 120.0  # to send a file; a head has 5 MB
BACKLOG = 128
KEEPALIVE_S = 20  # without data, until a client that has vanished is looked for
_KEEPALIVE_PROBES, _PROBE_S = 3, 5
_CHECK_S = 1.0
_RETRY_S = 1.0  # when the system has no free descriptor


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
    """Let the system close the connection of a client that has vanished, in 35 s."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    options = (
        ("TCP_KEEPIDLE", KEEPALIVE_S),
        ("TCP_KEEPINTVL", _PROBE_S),
        ("TCP_KEEPCNT", _KEEPALIVE_PROBES),
    )
    for name, value in options:
        if hasattr(socket, name):  # depends on the system
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class WebServer:
    """Accepts connections and serves them with an aiohttp application.

    ``listening`` is from ``bind_port``. ``on_refused`` is called with the address of each
    connection that exceeds a limit, ``on_bad_request`` when data arrives that is not HTTP.
    """

    def __init__(
        self,
        listening: socket.socket,
        tls: ssl.SSLContext | None,
        *,
        on_refused: Callable[[str], None],
        on_bad_request: Callable[[], None],
        address_share: float = ADDRESS_SHARE,
    ) -> None:
        self._listening = listening
        self._tls = tls
        self._on_refused = on_refused
        self._on_bad_request = on_bad_request
        self._quota = ConnectionQuota(MAX_CONNECTIONS, "connections", address_share)
        self._connections: set[asyncio.Task[None]] = set()
        self._deadlines_s: dict[asyncio.BaseProtocol, float] = {}

    async def start(self, application: web.Application, unlimited: Collection[str]) -> None:
        """Start serving an application.

        Answers of the ``unlimited`` paths have no time limit once the whole request has arrived.
        """

        @web.middleware
        async def set_deadline(request: web.Request, handler: Handler) -> web.StreamResponse:
            is_limited = request.path not in unlimited
            timeout_s = ANSWER_TIMEOUT_S if is_limited else BODY_TIMEOUT_S
            self._deadlines_s[request.protocol] = time.monotonic() + timeout_s
            if not is_limited:
                request.content.on_eof(lambda: self._remove_deadline(request.protocol))
            return await handler(request)

        application.middlewares.insert(0, set_deadline)
        log = LOG.getChild("http")
        log.addFilter(self._filter_client_errors)
        self._runner = web.AppRunner(
            application,
            access_log=None,
            logger=log,
            keepalive_timeout=IDLE_TIMEOUT_S,
            shutdown_timeout=0.5,
        )
        await self._runner.setup()
        self._server = cast(web.Server, self._runner.server)
        self._listening.setblocking(False)
        self._start_accepting()

    async def stop(self) -> None:
        """Accept no more connections and close the open ones."""
        asyncio.get_running_loop().remove_reader(self._listening)
        self._listening.close()
        await self._runner.cleanup()
        for connection in self._connections:
            connection.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)

    def _remove_deadline(self, connection: asyncio.BaseProtocol) -> None:
        if connection in self._deadlines_s:  # still open
            self._deadlines_s[connection] = math.inf

    def _start_accepting(self) -> None:
        if self._listening.fileno() >= 0:
            asyncio.get_running_loop().add_reader(self._listening, self._accept)

    def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            accepted, (address, *_) = self._listening.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:
            LOG.error("cannot accept a connection: %s", error.strerror)
            loop.remove_reader(self._listening)
            loop.call_later(_RETRY_S, self._start_accepting)
            return
        if not self._quota.acquire(address):
            accepted.close()
            self._on_refused(address)
            return
        _enable_keepalive(accepted)
        connection = loop.create_task(self._serve(accepted))
        self._connections.add(connection)
        connection.add_done_callback(self._connections.discard)
        connection.add_done_callback(lambda _: self._quota.release(address))

    async def _serve(self, accepted: socket.socket) -> None:
        """Serve a connection until it is closed or its deadline passes."""
        handler = self._server()
        self._deadlines_s[handler] = time.monotonic() + IDLE_TIMEOUT_S
        with contextlib.suppress(OSError):  # a TLS handshake that fails or takes too long
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: handler,
                accepted,
                ssl=self._tls,
                ssl_handshake_timeout=IDLE_TIMEOUT_S if self._tls else None,
            )
        try:
            while handler.transport is not None and time.monotonic() < self._deadlines_s[handler]:
                await asyncio.sleep(_CHECK_S)
        finally:
            del self._deadlines_s[handler]
            handler.force_close()

    def _filter_client_errors(self, record: logging.LogRecord) -> bool:
        """Filter errors that clients can cause at will: data that is not HTTP, partial bodies."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, HttpProcessingError):
            self._on_bad_request()
        return not isinstance(error, HttpProcessingError | ConnectionResetError)
