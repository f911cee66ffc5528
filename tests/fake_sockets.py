"""Sockets without a network for a client's core: tests read what it sends and pass time."""

import math
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from kouxing_client.messages import Fields, Message, decode, encode


@dataclass(eq=False)
class FakeConnection:
    """One socket: a request socket, an audio socket or a subscription."""

    endpoints: set[str]
    on_message: Callable[[Any], None]
    on_refused: Callable[[bool], None] = lambda _: None
    connect_ms: int = 0
    is_open: bool = True
    has_room: bool = True
    sent: list[tuple[str, Fields]] = field(default_factory=list)
    topics: set[bytes] = field(default_factory=set)
    unread: deque[Any] = field(default_factory=deque)

    def answer(self, kind: str, **fields: object) -> None:
        """Deliver a message about the session ``s`` from the server."""
        self.on_message(encode(kind, "s", fields))


class FakeSockets:
    """The part of ``Sockets`` that a client's core and a follower use."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.resumed_at_s = -math.inf
        self.connect_ms = 300
        self.connections: list[FakeConnection] = []
        self.unreachable_reason = ""
        self.num_explained = 0

    def explain(self, endpoint: str, on_reason: Callable[[str], None]) -> None:
        self.num_explained += 1
        on_reason(self.unreachable_reason)

    def at(self, endpoint: str) -> list[FakeConnection]:
        """Return the open connections to an endpoint, oldest first."""
        return [
            connection
            for connection in self.connections
            if connection.is_open and endpoint in connection.endpoints
        ]

    def publish(self, endpoint: str, *messages: Message) -> None:
        """Deliver messages to all subscribers of an endpoint."""
        for message in messages:
            for connection in self.at(endpoint):
                connection.on_message(message)

    def connect(
        self,
        endpoint: str,
        on_message: Callable[[Any], None],
        *,
        queue: int = 0,
        on_refused: Callable[[bool], None] = lambda _: None,
    ) -> FakeConnection:
        return self._open({endpoint}, on_message, on_refused)

    connect_events = connect

    def subscribe(
        self,
        session: str,
        classes: Collection[type[Any]],
        addresses: Collection[str],
        live_addresses: Collection[str],
        on_message: Callable[[Any], None],
    ) -> FakeConnection:
        return self._open({*addresses, *live_addresses}, on_message)

    def set_topics(self, connection: FakeConnection, topics: list[bytes], *, on: bool) -> None:
        connection.topics = connection.topics | {*topics} if on else connection.topics - {*topics}

    def send(self, connection: FakeConnection, parts: list[bytes]) -> bool:
        if connection.has_room:
            message = decode(parts)
            assert message is not None
            connection.sent.append(message)
        return connection.has_room

    def drain(self, connection: FakeConnection) -> None:
        while connection.unread and connection.is_open:
            connection.on_message(connection.unread.popleft())

    def close_connection(self, connection: FakeConnection) -> None:
        assert connection.is_open
        connection.is_open = False

    def _open(
        self,
        endpoints: set[str],
        on_message: Callable[[Any], None],
        on_refused: Callable[[bool], None] = lambda _: None,
    ) -> FakeConnection:
        connection = FakeConnection(endpoints, on_message, on_refused, self.connect_ms)
        self.connections.append(connection)
        return connection
