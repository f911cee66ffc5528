"""ZeroMQ sockets that carry messages, with limits against hostile peers.

Undecodable messages are returned as ``BadMessage``.
"""

import math
import secrets
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import TypeVar

import zmq
from kouxing_client.errors import KouxingError
from kouxing_client.keys import Key
from kouxing_client.messages import Joined, Message, topic
from kouxing_client.sockets import connect

from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import Record
from kouxing.shared.name_rules import is_name
from kouxing.shared.network.connection_limits import LimitedSocket
from kouxing.shared.network.peer import NO_PEER, Peer
from kouxing.shared.network.peer_connection import LONG_PENALTY_S, PENALTY_S, PeerConnection
from kouxing.shared.network.socket_limits import KIB
from kouxing.shared.network.waker import Waker
from kouxing.shared.network.zap import Zap
from kouxing.shared.settings.endpoints import split_endpoint
from kouxing.shared.settings.keys import Grant, may_subscribe
from kouxing.shared.wire.codec import BadMessage, decode, encode
from kouxing.shared.wire.session import Error

ERROR_COST = 4.0  # cost for the sender's budget of a message that is answered with an error
ANSWER_COST = 0.25  # cost per KiB of an answer: the longest status report is 15 MB
MAX_PARTS = 4
MAX_DROPPED = 20_000  # parts of one message that are dropped before the next socket
MAX_SUBSCRIPTIONS = 4096  # to different topics; with more, every message is encoded
MAX_BATCH = 200  # messages from one socket before the next socket
OnSubscribe = Callable[[str], Sequence[Message]]  # a session to the messages to publish again
T = TypeVar("T", int, str)
_MORE, _READABLE = zmq.DONTWAIT | zmq.SNDMORE, int(zmq.POLLIN)


class ReceivedMessage(Record, frozen=True):
    """A message or the reason why it is bad, and its sender (ROUTER sockets only)."""

    message: Message | BadMessage
    sender: Peer = NO_PEER


class Socket:
    """A ZeroMQ socket that sends and receives messages without blocking."""

    def __init__(
        self,
        raw: zmq.Socket[bytes],
        key: Key | None,
        zap: Zap | None = None,
        limited: LimitedSocket | None = None,
        *,
        is_router: bool = False,
        is_publisher: bool = False,
        on_subscribe: OnSubscribe | None = None,
        endpoint_name: str | None = None,
    ) -> None:
        self.raw = raw
        self._key = key
        self._zap = zap  # set if the socket is bound with a key
        self._limited = limited  # if the socket is bound
        self._is_router = is_router
        self._is_publisher = is_publisher
        self._on_subscribe = on_subscribe
        self._endpoint_name = endpoint_name  # set if the socket is bound, such as "faps"
        self._connection: PeerConnection | None = None  # connection of the last message
        self._sender = NO_PEER  # sender of the last message
        self._has_unread_parts = False  # unread parts of the last message remain
        self._unread_parts_from: PeerConnection | None = None
        self._name = secrets.token_hex(8)
        self._subscribed_topics: set[bytes] = set()  # subscriptions, now or before
        self._prefixes: tuple[bytes, ...] = ()  # prefixes that are not a whole topic
        self._max_topics = MAX_SUBSCRIPTIONS  # then ended subscriptions are forgotten

    @property
    def endpoint(self) -> str:
        """The bound endpoint with its port."""
        return self.raw.getsockopt_string(zmq.LAST_ENDPOINT)

    @property
    def file_descriptor(self) -> int:
        """Descriptor that becomes readable when the state may have changed (edge-triggered)."""
        return int(self.raw.getsockopt(zmq.FD))

    def send(self, message: Message, *, to: Peer = NO_PEER) -> bool:
        """Queue a message, on a ROUTER for one peer. Return False if the queue is full.

        An answer to the message that is being handled reduces its sender's budget.
        """
        if self._is_publisher and not self._has_subscriber(topic(message.kind, message.session)):
            return True
        parts = encode(message)
        if self._connection is not None and to == self._sender:
            cost = ERROR_COST if isinstance(message, Error) else 0.0
            self._connection.spend(cost + ANSWER_COST * len(parts[-1]) / KIB)
        if self._is_router:
            parts.insert(0, to.address)
        try:
            for part in parts[:-1]:  # faster than send_multipart
                self.raw.send(part, _MORE)
            self.raw.send(parts[-1], zmq.DONTWAIT)
        except zmq.Again:
            return False
        if self._limited is not None:
            self._limited.num_sent += 1
        return True

    def _has_subscriber(self, label: bytes) -> bool:
        """Return whether a topic may have a subscriber. Otherwise encoding is unnecessary."""
        return label in self._subscribed_topics or label.startswith(self._prefixes)

    def _add_subscription(self, subscription: bytes) -> None:
        """Record that a subscription, a topic or a prefix of topics, is in effect."""
        if len(self._subscribed_topics) >= self._max_topics:
            self._forget_ended_subscriptions()
        if subscription not in self._subscribed_topics:
            self._subscribed_topics.add(subscription)
            if not _is_whole_topic(subscription):
                self._prefixes += (subscription,)

    def _forget_ended_subscriptions(self) -> None:
        """Keep only the subscriptions of open connections."""
        if self._limited is None:
            return
        connections = self._limited.limiter.connections_to(self._limited)
        topics = {label for connection in connections for label in connection.topics}
        is_full = len(topics) >= MAX_SUBSCRIPTIONS
        prefixes = (label for label in topics if not _is_whole_topic(label))
        self._prefixes = (b"",) if is_full else tuple(prefixes)
        self._subscribed_topics = topics
        self._max_topics = max(MAX_SUBSCRIPTIONS, 2 * len(topics))

    def subscribe(self, kind: type[Message], session: str | None) -> None:
        """Subscribe to a kind of message, of one session or of all (None)."""
        prefix = f"{kind.kind}/".encode() if session is None else topic(kind.kind, session)
        self.raw.setsockopt(zmq.SUBSCRIBE, prefix)

    def receive(self) -> Iterator[ReceivedMessage]:
        """Yield the messages that have arrived, at most ``MAX_BATCH``.

        A publishing socket answers a new subscription to ``joined/<session>/`` with a ``joined``
        message. From then on, the subscriber misses nothing.
        """
        try:
            for number in range(MAX_BATCH):
                if self.raw.closed:  # by the handler of the last message
                    return
                # This check is cheaper than an exception.
                if number and not int(self.raw.get(zmq.EVENTS)) & _READABLE:
                    self.record_empty()
                    return
                try:
                    if self._has_unread_parts:
                        self._drop_unread_parts()
                    parts, key = self._receive_parts()
                except zmq.Again:
                    if not self._has_unread_parts:
                        self.record_empty()
                    return
                if self._connection is not None and self._connection.is_disconnected:
                    continue
                grant = None if self._zap is None else self._zap.grants.get(key)
                if self._zap is not None and grant is None:  # gone or revoked
                    continue
                if self._is_publisher:
                    self._on_subscription(parts, grant)
                    continue
                inode = self._connection.inode if self._connection is not None else 0
                self._sender = Peer(parts.pop(0), key, inode) if self._is_router else NO_PEER
                try:
                    yield ReceivedMessage(decode(parts), self._sender)
                except BadMessage as error:
                    yield ReceivedMessage(error, self._sender)
        finally:
            self._connection = None

    def disconnect_stalled(self, kinds: Collection[type[Message]], sessions: Iterable[str]) -> None:
        """Disconnect subscribers that stopped reading. Call this about once a second.

        This affects only subscribers to one of ``kinds`` of one of ``sessions``, because late
        frames of a live session are useless. libzmq reconnects the subscriber when it continues.
        """
        if self._limited is not None:
            topics = [topic(kind.kind, session) for session in sessions for kind in kinds]
            self._limited.disconnect_stalled(topics)

    def record_empty(self) -> None:
        """Record that all complete messages have been received."""
        if self._limited is not None:
            self._limited.num_polls += 1

    def is_open(self, connection: int) -> bool:
        """Return whether a connection to this bound socket has not ended, by its number."""
        return self._limited is not None and self._limited.limiter.is_open(connection)

    def ended(self) -> Iterator[int]:
        """Yield the numbers of connections that have ended since the last call."""
        while self._limited is not None and self._limited.ended:
            yield self._limited.ended.popleft()

    def wait(self, timeout_s: float) -> bool:
        """Wait for a message. Return False after the timeout."""
        return bool(self.raw.poll(int(timeout_s * 1000)))

    @property
    def can_send(self) -> bool:
        """Whether ``send`` would queue a message.

        This stays False after a peer broke the protocol in the handshake, because libzmq then
        abandons the connection and its queue.
        """
        return bool(self.raw.poll(0, zmq.POLLOUT))

    def connect(self, endpoint: str) -> None:
        """Connect to another peer.

        Raises ``UserError`` if the endpoint is malformed, or only one side uses encryption.
        """
        split_endpoint(endpoint.partition(" ")[0], "endpoint")
        try:
            connect(self.raw, endpoint, self._key)
        except KouxingError as error:
            raise UserError(str(error)) from None

    def close(self, *, linger_s: float = 1.0) -> None:
        """Close. Queued messages are dropped after ``linger_s``."""
        self.raw.close(linger=int(linger_s * 1000))

    def _receive_parts(self) -> tuple[list[bytes], str]:
        """Return the first parts of a message and its sender's key; raise ``zmq.Again`` if none."""
        frame = self.raw.recv(zmq.DONTWAIT, copy=False)
        parts = [frame.bytes]
        descriptor = -1 if self._limited is None else _property(frame, zmq.SRCFD, -1)
        while frame.more and len(parts) < MAX_PARTS:
            frame = self.raw.recv(zmq.DONTWAIT, copy=False)
            parts.append(frame.bytes)
        self._has_unread_parts = frame.more
        key = "" if self._zap is None else _property(frame, "User-Id", "")
        if self._limited is not None:
            self._connection = self._limited.count_delivery(descriptor, key)
            if self._has_unread_parts and self._connection is not None:
                self._unread_parts_from = self._connection
                self._connection.disconnect("its message has too many parts", PENALTY_S)
        return parts, key

    def _drop_unread_parts(self) -> None:
        """Drop the rest of a message; raise ``zmq.Again`` if parts are left for the next call."""
        for _ in range(MAX_DROPPED):
            if not self._has_unread_parts:
                return
            self._has_unread_parts = self.raw.recv(zmq.DONTWAIT, False).more  # positional: faster
        if self._has_unread_parts:
            if self._unread_parts_from is not None:
                self._unread_parts_from.budget.block(LONG_PENALTY_S)
            raise zmq.Again

    def _on_subscription(self, parts: list[bytes], grant: Grant | None) -> None:
        if len(parts) != 1:  # not a subscription
            return
        verb, subscription = parts[0][:1], parts[0][1:]
        if self._connection is not None and self._limited is not None:
            if verb == b"\x01":
                self._limited.subscribe(self._connection, subscription)
            else:
                self._connection.topics.discard(subscription)
            if self._connection.is_disconnected:
                return
        is_allowed = grant is None or may_subscribe(grant, subscription)  # None: without keys
        if verb == b"\x00":
            self.raw.setsockopt(zmq.UNSUBSCRIBE, subscription)
        elif verb == b"\x01" and is_allowed:
            self.raw.setsockopt(zmq.SUBSCRIBE, subscription)
            self._add_subscription(subscription)
            self._confirm_subscription(subscription)

    def _confirm_subscription(self, subscription: bytes) -> None:
        prefix = f"{Joined.kind}/".encode()
        session = subscription.removeprefix(prefix).decode("ascii", "replace").removesuffix("/")
        if subscription.startswith(prefix) and is_name(session):
            repeated = self._on_subscribe(session) if self._on_subscribe else ()
            self.send(
                Joined(
                    session=session,
                    publisher=self._name,
                    endpoint=self._endpoint_name,
                    repeats=bool(repeated),
                )
            )
            for message in repeated:
                self.send(message)


def _is_whole_topic(subscription: bytes) -> bool:
    return subscription.count(b"/") >= 2


def _property(frame: zmq.Frame, name: int | str, default: T) -> T:
    """Return a property of a frame's connection, the default if the connection has ended."""
    try:
        return type(default)(frame.get(name))
    except zmq.ZMQError:
        return default


class Poller:
    """Waits for several sockets."""

    def __init__(self) -> None:
        self._poller = zmq.Poller()
        self._sockets: dict[zmq.Socket[bytes], Socket] = {}
        self._quiet: set[zmq.Socket[bytes]] = set()  # sockets that do not end `wait`
        self._paused: set[zmq.Socket[bytes]] = set()
        self.waker = Waker()  # ends each `wait` until it is cleared
        self._poller.register(self.waker.descriptor, zmq.POLLIN)

    def add(self, socket: Socket, *, is_quiet: bool = False) -> None:
        """Watch a socket. A quiet socket does not end `wait`."""
        self._sockets[socket.raw] = socket
        if is_quiet:
            self._quiet.add(socket.raw)
        else:
            self._poller.register(socket.raw, zmq.POLLIN)

    def remove(self, socket: Socket) -> None:
        """Stop watching a socket."""
        self._poller.register(socket.raw, 0)  # 0: unregister, without an error if not registered
        del self._sockets[socket.raw]
        self._quiet.discard(socket.raw)
        self._paused.discard(socket.raw)

    def pause(self, socket: Socket, *, paused: bool) -> None:
        """Pause or resume a socket. `wait` does not return a paused socket."""
        if paused:
            self._paused.add(socket.raw)
        else:
            self._paused.discard(socket.raw)
        if socket.raw not in self._quiet:
            self._poller.register(socket.raw, 0 if paused else zmq.POLLIN)

    def is_paused(self, socket: Socket) -> bool:
        """Return whether a socket is paused."""
        return socket.raw in self._paused

    def wait(self, timeout_s: float) -> list[Socket]:
        """Return the readable sockets in the order in which they were added."""
        events = self._poller.poll(max(0, math.ceil(timeout_s * 1000)))
        ready = {raw for raw, _ in events}
        for raw in self._quiet - self._paused:
            if int(raw.get(zmq.EVENTS)) & _READABLE:
                ready.add(raw)
        readable = []
        for raw, socket in self._sockets.items():
            if raw in ready:
                readable.append(socket)
            elif raw not in self._paused:  # a paused socket may have messages
                socket.record_empty()
        return readable
