"""The ZeroMQ sockets of a process.

Services bind, clients connect. Every socket has explicit limits of message size, queue length and
linger. Connections are encrypted and both ends are authenticated (CURVE), unless the bus has no
key. The endpoint of a bound socket with a key includes the public key: ``tcp://HOST:PORT KEY``.
"""

import errno
import secrets
from collections.abc import Iterable
from enum import Enum
from typing import Self

import zmq
from kouxing_client.field_types import MAX_AUDIO_BYTES
from kouxing_client.keys import Key
from kouxing_client.sockets import HANDSHAKE_MS, LIVE_BUFFER_BYTES, QUEUE_MESSAGES, set_limits
from zmq.utils.monitor import recv_monitor_message

from kouxing.shared.errors import UserError
from kouxing.shared.network.connection_limits import ConnectionLimiter
from kouxing.shared.network.socket_limits import KIB, SocketLimits
from kouxing.shared.network.sockets import OnSubscribe, Socket
from kouxing.shared.network.waker import Waker
from kouxing.shared.network.zap import Zap, answer_handshakes
from kouxing.shared.settings.endpoints import split_endpoint
from kouxing.shared.wire.message import MAX_COMMAND_BYTES, MAX_MESSAGE_BYTES

# Few answers to audio are queued, because not every client reads them.
AUDIO_LIMITS = SocketLimits(part_bytes=MAX_AUDIO_BYTES + KIB, queue_length=4, num_answers=100)
COMMAND_LIMITS = SocketLimits(part_bytes=MAX_COMMAND_BYTES, queue_length=2, cost=1.0)
PHONE_LIMITS = SocketLimits(part_bytes=4 * KIB, queue_length=64)
# most of the cost is for the handshake
SUBSCRIPTION_LIMITS = SocketLimits(part_bytes=512, queue_length=32, cost=1.0)


def _bind_problem(error: zmq.ZMQError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "the port is in use; stop the program that uses it, or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return "this host has no such address; use one of its addresses, or 0.0.0.0"
    return f"{error.strerror or error}; use an address of this host"


class ProbeResult(Enum):
    """Result of an attempt to connect to an endpoint."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"  # the service rejects this key, or has another key
    UNREACHABLE = "unreachable"


class Bus:
    """The sockets of one process.

    With a key, the sockets accept only the allowed keys (see ``Zap``). Without a key, nothing is
    encrypted, and every peer is accepted. ``extra_connections`` are allowed in addition to the
    usual limit. Raises ``UserError`` if the allowed keys cannot be read.
    """

    def __init__(self, key: Key | None = None, *, extra_connections: int = 0) -> None:
        self._context = zmq.Context()
        self._key = key
        self._limiter = ConnectionLimiter(
            lambda key: self.zap is not None and self.zap.is_service(key), extra_connections
        )
        self.zap = None if key is None else Zap(self._limiter.disconnect_keys)
        self._answers_handshakes = False
        self._sockets: list[Socket] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def bind_router(
        self, endpoint: str, key: str, limits: SocketLimits = AUDIO_LIMITS, *, role: str = ""
    ) -> Socket:
        """Bind a socket that receives from many peers.

        If ``role`` is set, only keys with this role (``service``: any service) may connect.
        """
        if role and self.zap is not None:
            self.zap.required_roles[key] = role
        return self._bind(zmq.ROUTER, endpoint, key, limits)

    def bind_publisher(
        self, endpoint: str, key: str, on_subscribe: OnSubscribe | None = None
    ) -> Socket:
        """Bind a socket that many peers subscribe to.

        ``on_subscribe`` is called with the session when the subscriptions of a peer are in effect.
        It returns the messages to publish again.
        """
        return self._bind(zmq.XPUB, endpoint, key, SUBSCRIPTION_LIMITS, on_subscribe)

    def connect_dealer(self, endpoint: str) -> Socket:
        """Connect to a router. Messages are queued until it is available."""
        return self._connect(zmq.DEALER, endpoint)

    def connect_subscriber(self, *endpoints: str, live: Iterable[str] = ()) -> Socket:
        """Connect to publishers. Call ``subscribe`` to receive messages.

        For publishers in ``live`` the kernel buffers only a few messages, so that a stalled
        process has little to skip.
        """
        socket = self._connect(zmq.SUB, *endpoints)
        socket.raw.setsockopt(zmq.RCVBUF, LIVE_BUFFER_BYTES)
        for endpoint in live:
            socket.connect(endpoint)
        return socket

    def probe(self, endpoint: str, *, is_publisher: bool = False) -> ProbeResult:
        """Try to connect to a router or a publisher; this takes up to four seconds.

        A service that rejects the key closes the connection. A service that hangs does not.
        """
        probe = self._connect(zmq.SUB if is_publisher else zmq.DEALER, queue_length=1)
        probe.raw.setsockopt(zmq.HANDSHAKE_IVL, 3 * HANDSHAKE_MS)  # closed by the peer
        ends = {zmq.EVENT_HANDSHAKE_SUCCEEDED, zmq.EVENT_CONNECT_RETRIED}
        monitor = probe.raw.get_monitor_socket(sum({zmq.EVENT_CONNECTED, *ends}))
        probe.connect(endpoint)
        events: set[int] = set()
        while not events & ends and monitor.poll(2 * HANDSHAKE_MS):
            events.add(recv_monitor_message(monitor)["event"])
        probe.raw.disable_monitor()
        monitor.close()
        self.drop(probe, linger_s=0.0)
        if zmq.EVENT_HANDSHAKE_SUCCEEDED in events:
            return ProbeResult.ACCEPTED
        is_rejected = {zmq.EVENT_CONNECTED, zmq.EVENT_CONNECT_RETRIED} <= events
        return ProbeResult.REJECTED if is_rejected else ProbeResult.UNREACHABLE

    def wake_on_connections(self, waker: Waker) -> None:
        """Wake the caller's loop when a connection ends, or while a message is incomplete."""
        self._limiter.waker = waker

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
        set_limits(raw, queue_length)
        return raw

    def _bind(
        self,
        kind: int,
        endpoint: str,
        key: str,
        limits: SocketLimits,
        on_subscribe: OnSubscribe | None = None,
    ) -> Socket:
        split_endpoint(endpoint, key)
        raw = self._open(kind, limits.num_answers)
        raw.setsockopt(zmq.IPV6, "[" in endpoint)
        raw.setsockopt_string(zmq.ZAP_DOMAIN, key)  # with a domain, libzmq rejects ZMTP 1 and 2
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
            raise UserError(f"{key}: cannot bind {endpoint}: {_bind_problem(error)}") from None
        limited.port = int(raw.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        socket = Socket(
            raw,
            self._key,
            self.zap,
            limited,
            is_router=kind == zmq.ROUTER,
            is_publisher=kind == zmq.XPUB,
            on_subscribe=on_subscribe,
            endpoint_name=key.rpartition(".")[2],
        )
        self._sockets.append(socket)
        return socket

    def _connect(self, kind: int, *endpoints: str, queue_length: int = QUEUE_MESSAGES) -> Socket:
        raw = self._open(kind, queue_length)
        if kind == zmq.DEALER:  # a router recognizes this peer after a reconnect
            raw.setsockopt(zmq.ROUTING_ID, secrets.token_bytes(16).replace(b"\0", b"\1"))
        socket = Socket(raw, self._key)
        self._sockets.append(socket)
        for endpoint in endpoints:
            socket.connect(endpoint)
        return socket
