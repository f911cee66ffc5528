"""Follows one session: subscribes at its publishers, counts confirmations, notices restarts.

Whatever turns a running session into something else (a window, a browser's messages, a file,
another program's protocol) is a follower and a converter.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from kouxing.shared.bus import Bus, Socket
from kouxing.shared.clock import StallDetector
from kouxing.shared.errors import UserError
from kouxing.shared.keys import Peer
from kouxing.shared.metrics import Metrics
from kouxing.shared.wire.codec import BadMessage
from kouxing.shared.wire.face import EndOfFaps, FapFrame
from kouxing.shared.wire.kinds import PUBLISHER_OF
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import Joined

UNCONFIRMED_S = 3.0  # until a subscription that is not in effect is made anew
KEPT_S = 3.0  # a connection that may be dead, for what TCP still brings
CATCH_UP_S = 0.1  # after the process was stopped, within which all comes that waited
MAX_OLD = 8  # live frames of these that are taken

SocketHandlers = dict[type[Message], Callable[[Any, Peer], None]]


class MessageLoop(Protocol):
    """What calls a follower when messages arrive: a service, or a ``PollingLoop``."""

    bus: Bus
    metrics: Metrics
    stall: StallDetector  # tells when the process resumed after it had been stopped
    at_each_step: set[Callable[[], None]]  # what it calls besides, at least at each tick

    def register(self, socket: Socket, handlers: SocketHandlers) -> None:
        """Handle messages that arrive on a socket, by their type."""

    def unregister(self, socket: Socket) -> None:
        """Stop handling and close a socket."""


class SessionFollower:
    """Receives chosen kinds of messages of one session, through its moves, to its end.

    After a move it stays subscribed where it was until the new subscriptions are in effect, and
    ``KEPT_S`` longer if one of its publishers stays. It takes once what comes both ways, and a
    frame that is made again in a new epoch. Where a publisher does not confirm, it subscribes
    again: if another program was at its address before, libzmq never connects that socket again.

    Parameters
    ----------
    loop
        Reads the sockets.
    session
        Name of the session.
    handlers
        What to call with a message, by its class; these classes are subscribed to.
    live
        Whether frames are worth nothing when they are late: after this process was stopped for a
        while only the newest ``MAX_OLD`` of those that waited come.
    on_complete
        Called when every publisher has confirmed the subscriptions: no later message is missed.
        Called again after each ``start``.
    on_restart
        Called when the session goes on in a new epoch, before the epoch's first message.

    Attributes
    ----------
    epoch
        The greatest of a message or of the first start; 0 if neither has told it. Once a publisher
        has told of one, its messages of earlier ones are dropped; another's may still be unread.
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
        live: bool = True,
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
        self._live = live
        self._on_complete = on_complete
        self._on_restart = on_restart
        self._socket: Socket | None = None
        self._socket_before: Socket | None = None  # until the new one is complete, or longer
        self._leave_s = math.inf  # when it is left
        self._again_s = math.inf  # when the new one is given up unless it is complete
        self._addresses: set[str] = set()
        self._frame_addresses: set[str] = set()  # those of them with live frames
        self._stays = False  # it subscribed again at one of the same addresses
        self._confirmed: set[str] = set()
        self._first_epoch = 0  # that of the first start
        self._epochs: dict[str, int] = {}  # of the newest message, by publisher
        self._newest: dict[str, tuple[int, int]] = {}  # epoch and sequence of it, by publisher
        self._newest_before: dict[str, tuple[int, int]] = {}  # when it subscribed again
        self._taken: set[tuple[str, tuple[int, int]]] = set()  # since then
        self._last_frame = (-1, -1)  # media time and sequence
        self._last_sequence: int | None = None
        self._waiting: deque[FapFrame] = deque(maxlen=MAX_OLD)

    def start(self, epoch: int, endpoints: Mapping[str, str]) -> None:
        """Subscribe; when called again, subscribe where the session is published now.

        Parameters
        ----------
        epoch
            As in the first start message; 0 if unknown. Messages tell the later ones.
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
        addresses = {endpoints[name] for name in names}
        frames = {endpoints["faps"]} & addresses if self._live and "faps" in names else set()
        socket = self._connect(addresses, frames)
        stays = bool(addresses & self._addresses)
        if self._socket is not None and self._socket_before is not None and not self.is_complete:
            self._loop.unregister(self._socket)  # the one before is all there is so far
            self._stays = self._stays and stays
        else:
            self._leave_socket_before()
            self._socket_before, self._stays = self._socket, stays
            self._newest_before, self._taken = dict(self._newest), set()
        self._leave_s = math.inf
        self._addresses, self._frame_addresses = addresses, frames
        self._first_epoch = self._first_epoch or epoch
        self.epoch = self.epoch or epoch
        self._subscribe(socket)

    def close(self) -> None:
        """Unsubscribe; nothing is called any more."""
        for socket in (self._socket, self._socket_before):
            if socket is not None:
                self._loop.unregister(socket)
        self._socket = self._socket_before = None
        self._confirmed.clear()
        self.is_complete = False
        self._loop.at_each_step.discard(self._subscribe_again_if_due)

    def _connect(self, addresses: set[str], frames: set[str]) -> Socket:
        return self._loop.bus.connect_subscriber(*sorted(addresses - frames), live=frames)

    def _subscribe(self, socket: Socket) -> None:
        self._socket = socket
        self._confirmed.clear()
        self.is_complete = False
        self._again_s = time.monotonic() + UNCONFIRMED_S
        self._loop.at_each_step.add(self._subscribe_again_if_due)
        self._loop.register(
            socket,
            {
                Joined: lambda message, _: self._on_joined(message, socket),
                **dict.fromkeys(self._handlers, lambda message, _: self._on_message(message)),
            },
        )
        socket.subscribe_session(self._handlers, self.session)

    def _subscribe_again_if_due(self) -> None:
        if self._socket is not None and time.monotonic() >= self._again_s:
            self._loop.unregister(self._socket)
            self._subscribe(self._connect(self._addresses, self._frame_addresses))

    def _leave_if_due(self) -> None:
        if time.monotonic() >= self._leave_s:
            self._leave_s = math.inf
            self._leave_socket_before()

    def _leave_socket_before(self) -> None:
        """Take what came through the socket before, and close it."""
        socket = self._socket_before
        if socket is None:
            return
        while received := list(socket.receive()):
            for each in received:
                if type(each.message) in self._handlers:
                    self._on_message(each.message)
        if self._socket_before is socket:  # no handler has closed it
            self._loop.unregister(socket)
            self._socket_before = None

    def _on_joined(self, joined: Joined, socket: Socket) -> None:
        if socket is not self._socket:
            return
        self._confirmed.add(joined.publisher)
        # A publisher that came back confirms once more, under a new name.
        if not self.is_complete and len(self._confirmed) >= len(self._addresses):
            self._leave_s = time.monotonic() + (KEPT_S if self._stays else 0.0)
            self._leave_if_due()
            self.is_complete = True
            self._loop.at_each_step.discard(self._subscribe_again_if_due)
            self._on_complete()

    def _on_message(self, message: Any) -> None:
        is_catching_up = time.monotonic() < self._loop.stall.resumed_at_s + CATCH_UP_S
        if self._live and is_catching_up and isinstance(message, FapFrame):
            self._waiting.append(message)
            return
        while self._waiting:
            self._take(self._waiting.popleft())
        self._take(message)

    def _take(self, message: Any) -> None:
        known_epoch = self._epochs.get(PUBLISHER_OF[type(message)], self._first_epoch)
        has_passed = message.epoch < self.epoch and isinstance(message, EndOfFaps)
        if message.epoch < known_epoch or has_passed:
            self._loop.metrics.count("dropped_old_epoch")
            return
        if message.epoch > self.epoch:
            self._enter_epoch(message.epoch)
        if self._is_repeated(message):
            return
        if isinstance(message, FapFrame):
            self._count_missed(message.sequence)
        elif isinstance(message, EndOfFaps):
            self.has_ended = True
        self._handlers[type(message)](message)
        self._leave_if_due()

    def _is_repeated(self, message: Message) -> bool:
        """Return whether the message came before, through the other socket or in another epoch."""
        publisher, number = PUBLISHER_OF[type(message)], (message.epoch, message.sequence)
        is_older = number <= self._newest_before.get(publisher, (-1, -1))
        if is_older or (publisher, number) in self._taken:
            return True
        if self._socket_before is not None:
            self._taken.add((publisher, number))
        self._epochs[publisher] = message.epoch
        self._newest[publisher] = max(number, self._newest.get(publisher, number))
        if isinstance(message, FapFrame):
            place = (message.media_time, message.sequence)
            if place <= self._last_frame:
                return True
            self._last_frame = place
        return False

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
        self.stall = StallDetector(time.monotonic())
        self.at_each_step: set[Callable[[], None]] = set()
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
        for call in tuple(self.at_each_step):
            call()
        self.stall.restart(time.monotonic())
        sockets = self._poller.wait(timeout_s)
        self.stall.check(time.monotonic(), expected_s=timeout_s)
        for socket in sockets:
            for received in socket.receive():
                message = received.message
                if isinstance(message, BadMessage):
                    self.metrics.count(f"dropped_{message.reason}")
                elif type(message) in (handlers := self._handlers.get(socket, {})):
                    handlers[type(message)](message, received.sender)
        return bool(sockets)
