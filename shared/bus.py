"""ZeroMQ sockets that carry messages.

Services bind, clients connect. Every socket has explicit limits of message size, queue length and
linger. Undecodable messages are returned as ``BadMessage``.

Connections are encrypted and both ends are authenticated (CURVE), unless the bus has no key. The
endpoint of a bound socket with a key includes the public key: ``tcp://HOST:PORT KEY``.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from kouxing.shared.connections import (
    KIB,
    LONG_PENALTY_S,
    PENALTY_S,
    Connection,
    ConnectionLimiter,
    LimitedSocket,
    Limits,
)
from kouxing.shared.endpoints import split_endpoint
from kouxing.shared.errors import UserError
from kouxing.shared.keys import NO_PEER, Grant, Key, Peer, may_follow
from kouxing.shared.wire.codec import BadMessage, decode, encode, topic
from kouxing.shared.wire.message import (
    MAX_AUDIO_BYTES,
    MAX_COMMAND_BYTES,
    MAX_MESSAGE_BYTES,
    Message,
)
from kouxing.shared.wire.session import Error, Joined
from kouxing.shared.zap import Zap, answer_handshakes

QUEUE_LENGTH = 20_000  # messages: a subscriber to a recording may pause for 400 s
LIVE_BUFFER = 65_536  # bytes in the kernel: a few seconds of FAP frames
# Few answers to audio wait: not every client reads them.
AUDIO = Limits(part_bytes=MAX_AUDIO_BYTES + KIB, queue_length=4, num_answers=100)
COMMANDS = Limits(part_bytes=MAX_COMMAND_BYTES, queue_length=2, cost=1.0)
PHONES = Limits(part_bytes=4 * KIB, queue_length=64)
SUBSCRIPTIONS = Limits(part_bytes=512, queue_length=32, cost=1.0)  # most of it for the handshake
ERROR_COST = 4.0  # of the sender's budget, for each message that is answered with an error
ANSWER_COST = 0.25  # for each KiB of an answer: the longest status report has 15 MB
MAX_PARTS = 4
MAX_DROPPED = 20_000  # parts of one message, before other sockets get their turn
MAX_BATCH = 200  # messages from one socket, before other sockets get their turn
RECONNECT_MS = (20, 50)  # between attempts to connect, initial and maximum
CONNECT_MS = 300  # for one attempt; limits the round-trip time
HANDSHAKE_MS = 2000
_SESSION = re.compile(r"^[A-Za-z0-9_-]{1,64}$")


@dataclass(frozen=True, slots=True)
class Received:
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
        routes: bool = False,
        publishes: bool = False,
        on_joined: Callable[[str], None] = lambda session: None,
    ) -> None:
        self._raw = raw
        self._key = key
        self._zap = zap  # of a socket that is bound with a key
        self._limited = limited  # if it is bound
        self._routes = routes
        self._publishes = publishes
        self._on_joined = on_joined
        self._connection: Connection | None = None  # that the last message came through
        self._sender = NO_PEER  # of it
        self._has_rest = False  # parts of it that nobody wants
        self._rest_from: Connection | None = None  # whose they are
        self._name = secrets.token_hex(8)

    @property
    def endpoint(self) -> str:
        """The bound endpoint with its port."""
        return self._raw.getsockopt_string(zmq.LAST_ENDPOINT)

    @property
    def file_descriptor(self) -> int:
        """Becomes readable when the state may have changed (edge-triggered)."""
        return int(self._raw.getsockopt(zmq.FD))

    def send(self, message: Message, *, to: Peer = NO_PEER) -> bool:
        """Queue a message (on a ROUTER: to one peer). Return False if the queue is full.

        An answer to the message that is being handled reduces its sender's budget.
        """
        parts = encode(message)
        if self._connection is not None and to == self._sender:
            cost = ERROR_COST if isinstance(message, Error) else 0.0
            self._connection.spend(cost + ANSWER_COST * len(parts[-1]) / KIB)
        if self._routes:
            parts.insert(0, to.address)
        try:
            self._raw.send_multipart(parts, flags=zmq.DONTWAIT)
        except zmq.Again:
            return False
        if self._limited is not None:
            self._limited.num_sent += 1
        return True

    def subscribe(self, kind: type[Message], session: str | None) -> None:
        """Subscribe to a kind of message, of one session or of all (None)."""
        self._raw.setsockopt(zmq.SUBSCRIBE, _filter(kind, session))

    def subscribe_session(self, kinds: Iterable[type[Message]], session: str) -> None:
        """Subscribe to kinds of message of one session, and request a confirmation.

        Every publisher answers with one ``joined`` message when all of them are in effect:
        subscriptions keep their order, and the one to ``joined`` is the last.
        """
        for kind in (*kinds, Joined):
            self.subscribe(kind, session)

    def receive(self) -> Iterator[Received]:
        """Yield the messages that have arrived, at most ``MAX_BATCH``.

        A publishing socket answers a new subscription to ``joined/<session>/`` with a ``joined``
        message. From then on, the subscriber misses nothing.
        """
        try:
            for _ in range(MAX_BATCH):
                if self._raw.closed:  # by the handler of the last message
                    return
                try:
                    self._drop_rest()
                    parts, key = self._take()
                except zmq.Again:
                    if not self._has_rest:
                        self.note_empty()
                    return
                if self._connection is not None and self._connection.is_cut:
                    continue
                grant = None if self._zap is None else self._zap.grants.get(key)
                if self._zap is not None and grant is None:  # gone or revoked
                    continue
                if self._publishes:
                    self._on_subscription(parts, grant)
                    continue
                number = self._connection.inode if self._connection is not None else 0
                self._sender = Peer(parts.pop(0), key, number) if self._routes else NO_PEER
                try:
                    yield Received(decode(parts), self._sender)
                except BadMessage as error:
                    yield Received(error, self._sender)
        finally:
            self._connection = None

    def disconnect_stalled(self, kinds: Collection[type[Message]], sessions: Iterable[str]) -> None:
        """Disconnect subscribers that stopped reading. Call this about once a second.

        This affects only subscribers to one of ``kinds`` of one of ``sessions``: late frames of a
        live session are worthless. libzmq reconnects the subscriber when it continues.
        """
        if self._limited is not None:
            topics = [topic(kind, session) for session in sessions for kind in kinds]
            self._limited.disconnect_stalled(topics)

    def note_empty(self) -> None:
        """Note that all complete messages have been received."""
        if self._limited is not None:
            self._limited.num_polls += 1

    def is_open(self, connection: int) -> bool:
        """Return whether a connection to this bound socket has not ended, by its number."""
        return self._limited is not None and self._limited.has(connection)

    def ended(self) -> Iterator[int]:
        """Yield the numbers of connections that have ended since the last call."""
        while self._limited is not None and self._limited.ended:
            yield self._limited.ended.popleft()

    def wait(self, timeout_s: float) -> bool:
        """Wait for a message. Return False after the timeout."""
        return bool(self._raw.poll(int(timeout_s * 1000)))

    @property
    def can_send(self) -> bool:
        """Whether ``send`` would queue a message.

        This stays False after a peer broke the protocol in the handshake: libzmq then gives up
        the connection and its queue.
        """
        return bool(self._raw.poll(0, zmq.POLLOUT))

    def connect(self, endpoint: str) -> None:
        """Connect to another peer.

        Raises
        ------
        UserError
            If the endpoint is malformed, or only one side uses encryption.
        """
        address, _, server_key = endpoint.partition(" ")
        split_endpoint(address, "endpoint")
        if bool(server_key) != (self._key is not None):
            side = "this process" if server_key else f"the service at {address}"
            raise UserError(f"only {side} has insecure = true; set it for both or for neither")
        try:
            if self._key is not None:
                self._raw.setsockopt_string(zmq.CURVE_SERVERKEY, server_key)
                self._raw.setsockopt_string(zmq.CURVE_PUBLICKEY, self._key.public)
                self._raw.setsockopt_string(zmq.CURVE_SECRETKEY, self._key.secret)
            self._raw.setsockopt(zmq.IPV6, "[" in address)
            self._raw.connect(address)
        except zmq.ZMQError as error:
            raise UserError(f"cannot connect to {endpoint}: {error.strerror}") from None

    def close(self, *, linger_s: float = 1.0) -> None:
        """Close. Queued messages are dropped after ``linger_s``."""
        self._raw.close(linger=int(linger_s * 1000))

    @property
    def raw(self) -> zmq.Socket[bytes]:
        """The socket, for this module's poller."""
        return self._raw

    def _take(self) -> tuple[list[bytes], str]:
        """Return the first ``MAX_PARTS`` parts of a message, and its sender's key.

        Raises
        ------
        zmq.Again
            If no message has arrived.
        """
        frame = self._raw.recv(zmq.DONTWAIT, copy=False)
        parts = [frame.bytes]
        descriptor = _descriptor(frame)
        while frame.more and len(parts) < MAX_PARTS:
            frame = self._raw.recv(zmq.DONTWAIT, copy=False)
            parts.append(frame.bytes)
        self._has_rest = frame.more
        key = "" if self._zap is None else _key(frame)
        if self._limited is not None:
            self._connection = self._limited.deliver(descriptor, key)
            if self._has_rest and self._connection is not None:
                self._rest_from = self._connection
                self._connection.disconnect("its message has too many parts", PENALTY_S)
        return parts, key

    def _drop_rest(self) -> None:
        """Drop the remaining parts of a message, at most ``MAX_DROPPED`` at a time.

        Raises
        ------
        zmq.Again
            If parts are left for the next call.
        """
        for _ in range(MAX_DROPPED):
            if not self._has_rest:
                return
            self._has_rest = self._raw.recv(zmq.DONTWAIT, False).more  # positional: faster
        if self._has_rest:
            if self._rest_from is not None:
                self._rest_from.budget.block(LONG_PENALTY_S)
            raise zmq.Again

    def _on_subscription(self, parts: list[bytes], grant: Grant | None) -> None:
        if len(parts) != 1:  # not a subscription
            return
        verb, wanted = parts[0][:1], parts[0][1:]
        if self._connection is not None and self._limited is not None:
            if verb == b"\x01":
                self._limited.subscribe(self._connection, wanted)
            else:
                self._connection.topics.discard(wanted)
            if self._connection.is_cut:
                return
        may = grant is None or may_follow(grant, wanted)  # everyone may without keys
        if verb == b"\x00":
            self._raw.setsockopt(zmq.UNSUBSCRIBE, wanted)
        elif verb == b"\x01" and may:
            self._raw.setsockopt(zmq.SUBSCRIBE, wanted)
            self._confirm_subscription(wanted)

    def _confirm_subscription(self, wanted: bytes) -> None:
        prefix = f"{Joined.kind}/".encode()
        session = wanted.removeprefix(prefix).decode("ascii", "replace").removesuffix("/")
        if wanted.startswith(prefix) and _SESSION.match(session):
            self.send(Joined(session=session, publisher=self._name))
            self._on_joined(session)


def _descriptor(frame: zmq.Frame) -> int:
    """Return the descriptor of a frame's connection, -1 if that has ended."""
    try:
        return int(frame.get(zmq.SRCFD))
    except zmq.ZMQError:
        return -1


def _key(frame: zmq.Frame) -> str:
    """Return the key of a frame's sender, empty if the peer is gone."""
    try:
        return str(frame.get("User-Id"))
    except zmq.ZMQError:
        return ""


def _filter(kind: type[Message], session: str | None) -> bytes:
    return f"{kind.kind}/".encode() if session is None else topic(kind, session)


class Bus:
    """The sockets of one process.

    Parameters
    ----------
    key
        Key of this process; its sockets then accept only allowed keys. None disables encryption
        and accepts every peer.
    extra_connections
        Number of connections that are allowed in addition to the usual limit.

    Attributes
    ----------
    zap
        The allowed keys; None without encryption.

    Raises
    ------
    UserError
        If the allowed keys cannot be read.
    """

    def __init__(self, key: Key | None = None, *, extra_connections: int = 0) -> None:
        self._context = zmq.Context()
        self._limiter = ConnectionLimiter(extra_connections)
        self._key = key
        self.zap = None if key is None else Zap(self._limiter.disconnect_keys)
        self._answers_handshakes = False
        self._sockets: list[Socket] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def bind_router(
        self, endpoint: str, key: str, limits: Limits = AUDIO, *, role: str = ""
    ) -> Socket:
        """Bind a socket that receives from many peers.

        If a role is given, only keys with such a role (``service``: any service) may connect.
        """
        if role and self.zap is not None:
            self.zap.required_roles[key] = role
        return self._bind(zmq.ROUTER, endpoint, key, limits)

    def bind_publisher(
        self, endpoint: str, key: str, on_joined: Callable[[str], None] = lambda session: None
    ) -> Socket:
        """Bind a socket that many peers subscribe to.

        ``on_joined`` is called with the session when the subscriptions of a peer are in effect.
        """
        return self._bind(zmq.XPUB, endpoint, key, SUBSCRIPTIONS, on_joined)

    def connect_dealer(self, endpoint: str, *, queue_length: int = QUEUE_LENGTH) -> Socket:
        """Connect to a router. Messages are queued until it is available."""
        return self._connect(zmq.DEALER, endpoint, queue_length=queue_length)

    def connect_subscriber(self, *endpoints: str, live: Iterable[str] = ()) -> Socket:
        """Connect to publishers. Call ``subscribe`` to receive messages.

        For publishers in ``live`` the kernel buffers only a few messages, so that a stalled
        process has little to skip.
        """
        socket = self._connect(zmq.SUB, *endpoints, queue_length=QUEUE_LENGTH)
        socket.raw.setsockopt(zmq.RCVBUF, LIVE_BUFFER)
        for endpoint in live:
            socket.connect(endpoint)
        return socket

    def is_refused(self, endpoint: str) -> bool:
        """Return whether a service at an endpoint rejects this key, or has another key itself.

        A service that rejects the key closes the connection. A service that hangs does not.
        """
        probe = self._connect(zmq.DEALER, queue_length=1)
        probe.raw.setsockopt(zmq.HANDSHAKE_IVL, 3 * HANDSHAKE_MS)  # not closed from here first
        ends = {zmq.EVENT_HANDSHAKE_SUCCEEDED, zmq.EVENT_CONNECT_RETRIED}
        monitor = probe.raw.get_monitor_socket(sum({zmq.EVENT_CONNECTED, *ends}))
        probe.connect(endpoint)
        events: set[int] = set()
        while not events & ends and monitor.poll(2 * HANDSHAKE_MS):
            events.add(recv_monitor_message(monitor)["event"])
        probe.raw.disable_monitor()
        monitor.close()
        self.drop(probe, linger_s=0.0)
        return {zmq.EVENT_CONNECTED, zmq.EVENT_CONNECT_RETRIED} <= events

    def poller(self) -> Poller:
        """Return a poller for sockets of this bus."""
        return Poller()

    def drop(self, socket: Socket, *, linger_s: float = 1.0) -> None:
        """Close one socket (see ``Socket.close``)."""
        self._sockets.remove(socket)
        socket.close(linger_s=linger_s)

    def close(self) -> None:
        """Close every socket and the context."""
        self._limiter.close()
        for socket in self._sockets:
            socket.close()
        self._sockets.clear()
        self._context.term()

    def _open(self, kind: int, queue_length: int) -> zmq.Socket[bytes]:
        try:
            raw = self._context.socket(kind)
        except zmq.ZMQError as error:  # out of files
            raise OSError(error.errno, error.strerror) from None
        raw.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        raw.setsockopt(zmq.SNDHWM, queue_length)
        raw.setsockopt(zmq.RCVHWM, queue_length)
        raw.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS[0])
        raw.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_MS[1])
        raw.setsockopt(zmq.CONNECT_TIMEOUT, CONNECT_MS)
        raw.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        raw.setsockopt(zmq.LINGER, 0)
        return raw

    def _bind(
        self,
        kind: int,
        endpoint: str,
        key: str,
        limits: Limits,
        on_joined: Callable[[str], None] = lambda session: None,
    ) -> Socket:
        split_endpoint(endpoint, key)
        raw = self._open(kind, limits.num_answers)
        raw.setsockopt(zmq.IPV6, "[" in endpoint)
        raw.setsockopt_string(zmq.ZAP_DOMAIN, key)  # with one, libzmq refuses ZMTP 1 and 2
        if self._key is not None:
            raw.setsockopt(zmq.CURVE_SERVER, 1)
            raw.setsockopt_string(zmq.CURVE_SECRETKEY, self._key.secret)
            raw.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        if kind == zmq.XPUB:
            raw.setsockopt(zmq.XPUB_MANUAL, 1)
        if kind == zmq.ROUTER:
            raw.setsockopt(zmq.ROUTER_HANDOVER, 1)
        if not self._answers_handshakes:
            answer_handshakes(self._context, self.zap, self._limiter.is_blocked)
            self._answers_handshakes = True
        limited = self._limiter.limit(raw, limits)
        try:
            raw.bind(endpoint)
        except zmq.ZMQError as error:
            raw.close(linger=0)
            raise UserError(
                f"{key}: cannot bind {endpoint}: {error.strerror or error}; "
                "is another system running, or the address not this host's?"
            ) from None
        limited.port = int(raw.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        socket = Socket(
            raw,
            self._key,
            self.zap,
            limited,
            routes=kind == zmq.ROUTER,
            publishes=kind == zmq.XPUB,
            on_joined=on_joined,
        )
        self._sockets.append(socket)
        return socket

    def _connect(self, kind: int, *endpoints: str, queue_length: int) -> Socket:
        raw = self._open(kind, queue_length)
        if kind == zmq.DEALER:  # a router knows this peer again after a reconnect
            raw.setsockopt(zmq.ROUTING_ID, secrets.token_bytes(16).replace(b"\0", b"\1"))
        socket = Socket(raw, self._key)
        self._sockets.append(socket)
        for endpoint in endpoints:
            socket.connect(endpoint)
        return socket


class Poller:
    """Waits for several sockets."""

    def __init__(self) -> None:
        self._poller = zmq.Poller()
        self._sockets: dict[zmq.Socket[bytes], Socket] = {}

    def add(self, socket: Socket) -> None:
        """Watch a socket."""
        self._sockets[socket.raw] = socket
        self._poller.register(socket.raw, zmq.POLLIN)

    def remove(self, socket: Socket) -> None:
        """Stop watching a socket."""
        del self._sockets[socket.raw]
        self._poller.unregister(socket.raw)

    def wait(self, timeout_s: float) -> list[Socket]:
        """Return the readable sockets in the order in which they were added."""
        ready = dict(self._poller.poll(max(0, int(timeout_s * 1000))))
        for raw, socket in self._sockets.items():
            if raw not in ready:
                socket.note_empty()
        return [socket for raw, socket in self._sockets.items() if raw in ready]
