"""Handles the messages that arrive on the sockets of a service."""

import errno
import logging
import time
from collections.abc import Callable
from typing import Any

from kouxing_client.field_types import MAX_TEXT
from kouxing_client.messages import Message

from kouxing.shared.monitoring.logs import LOG, RateLimit
from kouxing.shared.monitoring.metrics import Metrics
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.peer import Peer
from kouxing.shared.network.sockets import Poller, ReceivedMessage, Socket
from kouxing.shared.wire.codec import BadMessage
from kouxing.shared.wire.session import Error, ErrorCode

MAX_TURN_S = 0.05  # time for the messages of one socket before the next socket

Handler = Callable[[Any, Peer], None]


class MessageLoop:
    """Passes messages to handlers, by socket and type, and counts messages and problems.

    ``current_session`` is the session whose message is being handled.
    """

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.metrics = Metrics()
        self.current_session = ""
        self._warning_limit = RateLimit()
        self._poller = Poller()
        self.waker = self._poller.waker  # ends every `wait` until it is cleared
        bus.wake_on_connections(self.waker)
        self._handlers: dict[Socket, dict[type[Message], Handler]] = {}

    def register(
        self, socket: Socket, handlers: dict[type[Message], Handler], *, is_quiet: bool = False
    ) -> None:
        """Handle the messages of a socket, by type. A quiet socket does not wake the loop."""
        self._handlers[socket] = handlers
        self._poller.add(socket, is_quiet=is_quiet)

    def unregister(self, socket: Socket) -> None:
        """Close a socket, and stop handling its messages."""
        self._poller.remove(socket)
        del self._handlers[socket]
        self.bus.drop(socket)

    def pause(self, socket: Socket, *, paused: bool) -> None:
        """Pause or resume a socket. Messages of a paused socket stay queued; their senders wait."""
        self._poller.pause(socket, paused=paused)

    def wait(self, timeout_s: float) -> list[Socket]:
        """Wait up to the timeout for messages; return the sockets with messages."""
        return self._poller.wait(timeout_s)

    def warn(self, reason: str, text: str, session: str = "", level: int = logging.WARNING) -> None:
        """Count a problem, and log it at a limited rate."""
        self.metrics.count(f"dropped_{reason}")
        if self._warning_limit.allows(reason):
            LOG.log(level, text, extra={"session": session})

    def handle_messages(self, socket: Socket) -> None:
        """Handle a socket's received messages, for up to ``MAX_TURN_S``."""
        handlers = self._handlers.get(socket)
        if handlers is None:  # a handler has closed the socket in this step
            return
        end_s = time.monotonic() + MAX_TURN_S
        for received in socket.receive():
            self._dispatch(socket, handlers, received)
            if self._poller.is_paused(socket) or time.monotonic() > end_s:
                break

    def _dispatch(
        self, socket: Socket, handlers: dict[type[Message], Handler], received: ReceivedMessage
    ) -> None:
        message, sender = received.message, received.sender
        if isinstance(message, BadMessage):
            grant = self.bus.zap.grants.get(sender.key) if self.bus.zap is not None else None
            origin = f" with the key {grant.name}" if grant is not None else ""
            self.warn(message.reason, f"dropped a message{origin}: {message}")
            _answer_bad_message(socket, sender, message)
            return
        handler = handlers.get(type(message))
        if handler is None:
            text = f"dropped a {message.kind} message: not expected here"
            self.warn("unexpected", text, message.session)
            error = BadMessage("unexpected", f"this socket does not accept {message.kind}")
            error.request = getattr(message, "request", None)
            _answer_bad_message(socket, sender, error)
            return
        self.metrics.count(f"in_{message.kind.replace('-', '_')}")
        self.current_session = message.session
        try:
            handler(message, sender)
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE):
                raise
            self.warn("files", f"{message.kind}: {error.strerror}", message.session)
        self.current_session = ""


def _answer_bad_message(socket: Socket, sender: Peer, error: BadMessage) -> None:
    """Answer in the sender's version, so that the sender can read the answer."""
    if sender.address:
        answer = Error(
            version=error.version,
            code=ErrorCode.BAD_MESSAGE,
            text=str(error)[:MAX_TEXT],
            request=error.request,
        )
        socket.send(answer, to=sender)
