"""Subscribes to a session inside the loop of a service."""

import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

from kouxing_client.follower import Follower
from kouxing_client.messages import Message

from kouxing.shared.network.sockets import Socket
from kouxing.shared.service.session_service import SessionService
from kouxing.shared.wire.control import StartSession


class SessionFollower(Follower):
    """Passes a session's messages to handlers; counts missed frames in the service's metrics.

    Control is notified when the subscriptions are in effect. ``session_start`` is control's newest
    message about the session. ``handlers`` has functions by class of message; these classes are
    subscribed to. For ``on_new_epoch``, see ``Follower``.
    """

    def __init__(
        self,
        service: SessionService,
        session_start: StartSession,
        handlers: Mapping[type[Message], Callable[[Any], None]],
        *,
        on_new_epoch: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(
            _ServiceTransport(service),
            session_start.session,
            handlers.keys(),
            self._handle,
            is_paced=session_start.opening.paced,
            on_complete=lambda: service.session_started(self.session_start),
            on_new_epoch=on_new_epoch,
        )
        self.session_start = session_start
        self.is_following = False
        self._service = service
        self._handlers = handlers
        self._counted = {"frames_missed": 0, "dropped_old_epoch": 0}

    def follow(self) -> None:
        """Subscribe at the endpoints of ``session_start``."""
        self.is_following = True
        self.start(self.session_start.epoch, self.session_start.endpoints)
        self._service.tick_callbacks.add(self.tick)

    def close(self) -> None:
        """Unsubscribe, as ``Follower.close``."""
        super().close()
        self._service.tick_callbacks.discard(self.tick)

    def _handle(self, message: Any) -> None:
        counts = {"frames_missed": self.num_missed, "dropped_old_epoch": self.num_outdated}
        if counts != self._counted:
            for name, count in counts.items():
                self._service.metrics.count(name, count - self._counted[name])
            self._counted = counts
        self._handlers[type(message)](message)


class _ServiceTransport:
    """Subscribes with the sockets of a service."""

    def __init__(self, service: SessionService) -> None:
        self._service = service
        self._on_message: dict[Socket, Callable[[Any], None]] = {}

    @property
    def now_s(self) -> float:
        return time.monotonic()

    @property
    def resumed_at_s(self) -> float:
        return self._service.stall_detector.resumed_at_s

    def subscribe(
        self,
        session: str,
        classes: Collection[type[Message]],
        addresses: Collection[str],
        live_addresses: Collection[str],
        on_message: Callable[[Any], None],
    ) -> Socket:
        socket = self._service.bus.connect_subscriber(*sorted(addresses), live=live_addresses)
        self._service.register(
            socket, dict.fromkeys(classes, lambda message, _: on_message(message))
        )
        self._on_message[socket] = on_message
        for kind in classes:
            socket.subscribe(kind, session)
        return socket

    def drain(self, connection: Socket) -> None:
        while connection in self._on_message and (received := list(connection.receive())):
            for item in received:
                if isinstance(item.message, Message) and connection in self._on_message:
                    self._on_message[connection](item.message)

    def close_connection(self, connection: Socket) -> None:
        del self._on_message[connection]
        self._service.unregister(connection)
