"""Follows one session: subscribes at its publishers, counts confirmations, notices restarts.

Whatever turns a running session into something else (a window, a browser's messages, a file,
another program's protocol) is a follower and a converter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from shared.bus import Bus, Socket
from shared.errors import UserError
from shared.keys import Peer
from shared.metrics import Metrics
from shared.wire.codec import BadMessage
from shared.wire.face import EndOfFaps, FapFrame
from shared.wire.kinds import PUBLISHER_OF
from shared.wire.message import Message
from shared.wire.session import Joined

SocketHandlers = dict[type[Message], Callable[[Any, Peer], None]]


class MessageLoop(Protocol):
    """What calls a follower when messages arrive: a service, or a ``PollingLoop``."""

    bus: Bus
    metrics: Metrics

    def register(self, socket: Socket, handlers: SocketHandlers) -> None:
        """Handle messages that arrive on a socket, by their type."""

    def unregister(self, socket: Socket) -> None:
        """Stop handling and close a socket."""


class SessionFollower:
    """Receives chosen kinds of messages of one session, through its restarts, to its end.

    Parameters
    ----------
    loop
        Reads the sockets.
    session
        Name of the session.
    handlers
        What to call with a message, by its class; these classes are subscribed to.
    on_complete
        Called when every publisher has confirmed the subscriptions: no later message is missed.
        Called again after each ``start``.
    on_restart
        Called when the session goes on in a new epoch, before the epoch's first message.

    Attributes
    ----------
    epoch
        The session's restarts as far as known here; 0 before the first message or start tells.
        Messages of an earlier epoch are dropped.
    is_complete
        Whether every publisher has confirmed.
    has_ended
        Whether the last FAP frame has come; needs ``EndOfFaps`` among the handlers.
    num_missed
        FAP frames that were published and did not come, by gaps in their sequence numbers.
    """

    def __init__(
        self,
        loop: MessageLoop,
        session: str,
        handlers: Mapping[type[Message], Callable[[Any], None]],
        *,
        on_complete: Callable[[], None] = lambda: None,
        on_restart: Callable[[], None] = lambda: None,
    ) -> None:
        self.session = session
        self.epoch = 0
        self.is_complete = False
        self.has_ended = False
        self.num_missed = 0
        self._loop = loop
        self._handlers = handlers
        self._on_complete = on_complete
        self._on_restart = on_restart
        self._socket: Socket | None = None
        self._num_publishers = 0
        self._confirmed: set[str] = set()
        self._last_sequence: int | None = None

    def start(self, epoch: int, endpoints: Mapping[str, str]) -> None:
        """Subscribe; when called again, subscribe where the session is published now.

        Parameters
        ----------
        epoch
            As in the start message; 0 if unknown.
        endpoints
            Addresses of the session's publishers, by name (``phones``, ``faps``).

        Raises
        ------
        UserError
            If an endpoint is missing or malformed.
        """
        names = {PUBLISHER_OF[kind] for kind in self._handlers}
        missing = sorted(names - endpoints.keys())
        if missing:
            raise UserError(f"session {self.session}: no endpoint is named for {missing[0]!r}")
        self.close()
        addresses = sorted({endpoints[name] for name in names})
        self._num_publishers = len(addresses)
        self._last_sequence = None
        self._enter_epoch(epoch)
        self._socket = self._loop.bus.connect_subscriber(*addresses)
        self._loop.register(
            self._socket,
            {
                Joined: lambda message, _: self._on_joined(message),
                **dict.fromkeys(self._handlers, lambda message, _: self._on_message(message)),
            },
        )
        self._socket.subscribe_session(self._handlers, self.session)

    def close(self) -> None:
        """Unsubscribe; nothing is called any more."""
        if self._socket is not None:
            self._loop.unregister(self._socket)
        self._socket = None
        self._confirmed.clear()
        self.is_complete = False

    def _on_joined(self, joined: Joined) -> None:
        self._confirmed.add(joined.publisher)
        # A publisher that came back confirms once more, under a new name.
        if not self.is_complete and len(self._confirmed) >= self._num_publishers:
            self.is_complete = True
            self._on_complete()

    def _on_message(self, message: Message) -> None:
        if message.epoch < self.epoch:
            self._loop.metrics.count("dropped_old_epoch")
            return
        if message.epoch > self.epoch:  # the publisher restarted; control may tell later
            self._enter_epoch(message.epoch)
        if isinstance(message, FapFrame):
            self._count_missed(message.sequence)
        elif isinstance(message, EndOfFaps):
            self.has_ended = True
        self._handlers[type(message)](message)

    def _enter_epoch(self, epoch: int) -> None:
        is_restart = 0 < self.epoch != epoch
        self.epoch = epoch
        if is_restart:
            self.has_ended = False
            self._last_sequence = None
            self._on_restart()

    def _count_missed(self, sequence: int) -> None:
        if self._last_sequence is not None and sequence > self._last_sequence + 1:
            num_missed = sequence - self._last_sequence - 1
            self.num_missed += num_missed
            self._loop.metrics.count("frames_missed", num_missed)
        self._last_sequence = sequence


class PollingLoop:
    """Calls followers' handlers in a program that is no service."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.metrics = Metrics()
        self._poller = bus.poller()
        self._handlers: dict[Socket, SocketHandlers] = {}

    def register(self, socket: Socket, handlers: SocketHandlers) -> None:
        """Handle messages that arrive on a socket, by their type."""
        self._handlers[socket] = handlers
        self._poller.add(socket)

    def unregister(self, socket: Socket) -> None:
        """Stop handling and close a socket."""
        self._poller.remove(socket)
        del self._handlers[socket]
        self.bus.drop(socket)

    def step(self, timeout_s: float) -> bool:
        """Handle what has arrived, waiting up to the timeout; return whether anything had."""
        sockets = self._poller.wait(timeout_s)
        for socket in sockets:
            for received in socket.receive():
                message = received.message
                if isinstance(message, BadMessage):
                    self.metrics.count(f"dropped_{message.reason}")
                elif type(message) in (handlers := self._handlers.get(socket, {})):
                    handlers[type(message)](message, received.sender)
        return bool(sockets)
