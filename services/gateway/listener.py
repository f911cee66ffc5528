"""The gateway's port: so many connections in all and of one address, and none that idles."""

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

from kouxing.services.gateway.places import ADDRESS_SHARE, Places
from kouxing.shared.errors import UserError
from kouxing.shared.logs import LOG

MAX_CONNECTIONS = 256
IDLE_LIMIT_S = 10.0  # for a request to arrive, and for the next one
BODY_LIMIT_S = 70.0  # for its body, where it may take its time; before that an upload is answered
ANSWER_LIMIT_S = 120.0  # for a file to leave; a head is 5 MB
BACKLOG = 128
_CHECK_S = 1.0
_RETRY_S = 1.0  # when the system has no descriptor left


def bind(host: str, port: int, key: str = "gateway.port") -> socket.socket:
    """Return a listening socket; ``key`` is where the port was configured.

    Raises
    ------
    UserError
        If the address cannot be had, naming the configuration key.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise UserError(
                f"{key}: {port} is in use on {host}; choose another (0: any free one)"
            ) from None
        if error.errno == errno.EACCES:
            raise UserError(f"{key}: {port} needs privileges; choose 1024 or more") from None
        raise UserError(
            f"gateway.host: cannot listen on {host!r}: {error.strerror}; "
            "use 127.0.0.1, or an address of this host"
        ) from None


class Listener:
    """Takes connections and hands them to the web server, as long as they ask for something.

    Parameters
    ----------
    listening
        From ``bind``.
    tls
        For https; None: http.
    on_refused
        Called with the address of a connection that was one too many.
    on_bad_request
        Called when something that is no HTTP arrives.
    share
        Of the connections, for one address.
    """

    def __init__(
        self,
        listening: socket.socket,
        tls: ssl.SSLContext | None,
        *,
        on_refused: Callable[[str], None],
        on_bad_request: Callable[[], None],
        share: float = ADDRESS_SHARE,
    ) -> None:
        self._listening = listening
        self._tls = tls
        self._on_refused = on_refused
        self._on_bad_request = on_bad_request
        self._places = Places(MAX_CONNECTIONS, "connections", share)
        self._connections: set[asyncio.Task[None]] = set()
        self._due_s: dict[asyncio.BaseProtocol, float] = {}  # when each of them is ended

    async def start(self, application: web.Application, unlimited: Collection[str]) -> None:
        """Serve an application from here on.

        Answers of the ``unlimited`` paths take their time, once the request is there as a whole.
        """

        @web.middleware
        async def give_time(request: web.Request, handler: Handler) -> web.StreamResponse:
            is_limited = request.path not in unlimited
            limit_s = ANSWER_LIMIT_S if is_limited else BODY_LIMIT_S
            self._due_s[request.protocol] = time.monotonic() + limit_s
            if not is_limited:
                request.content.on_eof(lambda: self._give_all_time(request.protocol))
            return await handler(request)

        application.middlewares.insert(0, give_time)
        log = LOG.getChild("http")
        log.addFilter(self._is_worth_logging)
        self._runner = web.AppRunner(
            application,
            access_log=None,
            logger=log,
            keepalive_timeout=IDLE_LIMIT_S,
            shutdown_timeout=0.5,
        )
        await self._runner.setup()
        self._server = cast(web.Server, self._runner.server)
        self._listening.setblocking(False)
        self._resume()

    async def stop(self) -> None:
        """Take no more connections, and end those that are open."""
        asyncio.get_running_loop().remove_reader(self._listening)
        self._listening.close()
        await self._runner.cleanup()
        for connection in self._connections:
            connection.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)

    def _give_all_time(self, connection: asyncio.BaseProtocol) -> None:
        if connection in self._due_s:  # it is still open
            self._due_s[connection] = math.inf

    def _resume(self) -> None:
        if self._listening.fileno() >= 0:
            asyncio.get_running_loop().add_reader(self._listening, self._accept)

    def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            accepted, (address, *_) = self._listening.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:
            LOG.error("no connection can be taken: %s", error.strerror)
            loop.remove_reader(self._listening)
            loop.call_later(_RETRY_S, self._resume)
            return
        if not self._places.take(address):
            accepted.close()
            self._on_refused(address)
            return
        connection = loop.create_task(self._serve(accepted))
        self._connections.add(connection)
        connection.add_done_callback(self._connections.discard)
        connection.add_done_callback(lambda _: self._places.leave(address))

    async def _serve(self, accepted: socket.socket) -> None:
        """Serve a connection until it is closed or asks for nothing."""
        handler = self._server()
        self._due_s[handler] = time.monotonic() + IDLE_LIMIT_S
        with contextlib.suppress(OSError):  # a TLS handshake that fails or takes too long
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: handler,
                accepted,
                ssl=self._tls,
                ssl_handshake_timeout=IDLE_LIMIT_S if self._tls else None,
            )
        try:
            while handler.transport is not None and time.monotonic() < self._due_s[handler]:
                await asyncio.sleep(_CHECK_S)
        finally:
            del self._due_s[handler]
            handler.force_close()

    def _is_worth_logging(self, record: logging.LogRecord) -> bool:
        """Keep from filling the log: bytes that are no HTTP, and were answered so; half a body."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, HttpProcessingError):
            self._on_bad_request()
        return not isinstance(error, HttpProcessingError | ConnectionResetError)
