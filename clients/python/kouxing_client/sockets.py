"""The ZeroMQ sockets of one client. One thread uses them; other threads hand it functions."""

import contextlib
import math
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Collection

import zmq
from zmq.utils.monitor import parse_monitor_message

from kouxing_client.connection_check import explain_unreachable
from kouxing_client.errors import KouxingError
from kouxing_client.keys import Key
from kouxing_client.messages import Decoders, Message, topic

QUEUE_MESSAGES = 20_000  # a subscriber to a recording may pause for 400 s
LIVE_BUFFER_BYTES = 65_536  # in the kernel: some seconds of FAP frames, over any distance
RECONNECT_MS = (20, 50)  # initial and maximum interval between attempts to connect
CONNECT_MS = 300  # limit for one attempt; a lost packet costs the whole limit
HANDSHAKE_MS = 2000
_EXPLAIN_TIMEOUT_S = 1.0  # limit for finding out why an address does not answer
STALL_S = 0.5  # if a wait takes this much longer than requested, the process was stalled
_MONITORED = zmq.EVENT_CONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_CONNECT_RETRIED

Connection = zmq.Socket[bytes]


def set_limits(raw: Connection, queue: int, connect_ms: int = CONNECT_MS) -> None:
    """Set the limits of a socket: messages in its queue, and the times to connect."""
    raw.linger, raw.sndhwm, raw.rcvhwm = 0, queue, queue
    raw.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS[0])
    raw.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_MS[1])
    raw.setsockopt(zmq.CONNECT_TIMEOUT, connect_ms)
    raw.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)


def connect(raw: Connection, endpoint: str, key: Key | None) -> None:
    """Connect a socket to an address, which the server's public key may follow after a space.

    Raises ``KouxingError`` if the address is malformed, or only one side uses encryption.
    """
    address, _, server = endpoint.partition(" ")
    if bool(server) != (key is not None):
        raise KouxingError(
            f"{address} uses encryption, but this program does not: leave out 'insecure' here"
            if server
            else f"{address} uses no encryption, but this program does: set 'insecure' in every"
            " program, or in none"
        )
    try:
        if key is not None:
            raw.setsockopt_string(zmq.CURVE_SERVERKEY, server)
            raw.setsockopt_string(zmq.CURVE_PUBLICKEY, key.public)
            raw.setsockopt_string(zmq.CURVE_SECRETKEY, key.secret)
        raw.setsockopt(zmq.IPV6, "[" in address)
        raw.connect(address)
    except zmq.ZMQError as error:
        raise KouxingError(
            f"cannot connect to {address!r}: {error.strerror}; write tcp://HOST:PORT"
        ) from None


class Sockets:
    """Opens sockets and delivers the messages that they receive.

    Any thread may use ``call`` and, after ``close``, ``run_calls``. All other methods are for the
    thread that calls ``step``, and for the constructor's thread before that.

    The key is this program's; None if nothing is encrypted.
    """

    def __init__(self, key: Key | None) -> None:
        self.connect_ms = CONNECT_MS  # limit for one attempt, of sockets opened from now on
        self.resumed_at_s = -math.inf  # when this process last resumed after a suspension
        self._key = key
        self._context = zmq.Context()
        self._poller = zmq.Poller()
        self._handlers: dict[Connection, Callable[[list[bytes]], None]] = {}
        self._monitors: dict[Connection, Connection] = {}
        self._calls: deque[Callable[[], None]] = deque()
        self._woken, self._waker = socket.socketpair()
        self._woken.setblocking(False)
        self._waker.setblocking(False)
        self._poller.register(self._woken, zmq.POLLIN)

    @property
    def now_s(self) -> float:
        """Monotonic time."""
        return time.monotonic()

    def call(self, function: Callable[[], None]) -> None:
        """Let the thread call a function soon."""
        self._calls.append(function)
        with contextlib.suppress(OSError):  # the pipe is full or closed
            self._waker.send(b"\0")

    def step(self, timeout_s: float) -> None:
        """Wait up to the timeout, then handle received messages and requested calls."""
        begin_s = time.monotonic()
        ready = self._poller.poll(math.ceil(1000 * timeout_s))
        if time.monotonic() > begin_s + timeout_s + STALL_S:
            self.resumed_at_s = time.monotonic()
        for raw, _ in ready:
            if isinstance(raw, zmq.Socket):
                self.drain(raw)
        with contextlib.suppress(BlockingIOError):
            self._woken.recv(4096)
        self.run_calls()

    def run_calls(self) -> None:
        """Run the requested calls."""
        while self._calls:
            try:
                function = self._calls.popleft()
            except IndexError:  # another thread has taken the last one
                return
            function()

    def connect(
        self,
        endpoint: str,
        on_message: Callable[[list[bytes]], None],
        *,
        queue: int = QUEUE_MESSAGES,
        on_refused: Callable[[bool], None] | None = None,
    ) -> Connection:
        """Connect to a ROUTER socket, whose public key may follow its address after a space.

        ``on_message`` is called with the parts of each message, and ``on_refused`` when an attempt
        to connect shows whether the server rejects this key.

        Raises
        ------
        KouxingError
            If the endpoint is invalid.
        """
        raw = self._open(zmq.DEALER, queue, on_message)
        raw.setsockopt(zmq.ROUTING_ID, b"\1" + secrets.token_bytes(15))  # the same on reconnection
        if on_refused is not None:
            self._monitor(raw, on_refused)
        self._connect(raw, endpoint)
        return raw

    def subscribe(
        self,
        session: str,
        classes: Collection[type[Message]],
        addresses: Collection[str],
        live_addresses: Collection[str],
        on_message: Callable[[Message], None],
    ) -> Connection:
        """Subscribe to a session's messages, as ``Transport.subscribe`` describes."""
        decoders = Decoders(*classes)

        def decode(parts: list[bytes]) -> None:
            if (message := decoders.decode(parts)) is not None:
                on_message(message)

        raw = self._open(zmq.SUB, QUEUE_MESSAGES, decode)
        for endpoint in sorted(addresses):
            self._connect(raw, endpoint)
        raw.setsockopt(zmq.RCVBUF, LIVE_BUFFER_BYTES)
        for endpoint in sorted(live_addresses):
            self._connect(raw, endpoint)
        self.set_topics(raw, [topic(cls.kind, session) for cls in classes], on=True)
        return raw

    def connect_events(
        self, endpoint: str, on_message: Callable[[list[bytes]], None]
    ) -> Connection:
        """Connect to the socket where control publishes events."""
        raw = self._open(zmq.SUB, QUEUE_MESSAGES, on_message)
        self._connect(raw, endpoint)
        return raw

    def set_topics(self, connection: Connection, topics: list[bytes], *, on: bool) -> None:
        """Subscribe to topics, or unsubscribe."""
        for name in topics:
            connection.setsockopt(zmq.SUBSCRIBE if on else zmq.UNSUBSCRIBE, name)

    def send(self, connection: Connection, parts: list[bytes]) -> bool:
        """Send a message; return whether the socket accepted it."""
        try:
            connection.send_multipart(parts, zmq.DONTWAIT)
        except zmq.Again:
            return False
        return True

    def drain(self, connection: Connection) -> None:
        """Handle the messages that have arrived, until the connection is closed."""
        with contextlib.suppress(zmq.Again):
            while (handler := self._handlers.get(connection)) is not None:
                handler(connection.recv_multipart(zmq.DONTWAIT))

    def close_connection(self, connection: Connection) -> None:
        """Close a connection."""
        if (monitor := self._monitors.pop(connection, None)) is not None:
            connection.disable_monitor()
            self.close_connection(monitor)
        self._poller.unregister(connection)
        del self._handlers[connection]
        connection.close()

    def explain(self, endpoint: str, on_reason: Callable[[str], None]) -> None:
        """Call ``on_reason`` soon with why an endpoint cannot be reached; empty if it can."""
        address = endpoint.partition(" ")[0]
        host, _, port = address.removeprefix("tcp://").rpartition(":")

        def run() -> None:
            reason = (
                explain_unreachable(host, port, _EXPLAIN_TIMEOUT_S, is_zeromq=True)
                if port.isdigit()
                else ""
            )
            self.call(lambda: on_reason(reason))

        threading.Thread(target=run, daemon=True).start()

    def close(self) -> None:
        """Close all connections."""
        self._context.destroy(linger=0)
        self._woken.close()
        self._waker.close()

    def _open(self, kind: int, queue: int, on_message: Callable[[list[bytes]], None]) -> Connection:
        try:
            raw: Connection = self._context.socket(kind)
        except zmq.ZMQError as error:  # such as too many open files
            raise KouxingError(f"cannot open a socket: {error.strerror}") from None
        set_limits(raw, queue, self.connect_ms)
        self._handlers[raw] = on_message
        self._poller.register(raw, zmq.POLLIN)
        return raw

    def _connect(self, raw: Connection, endpoint: str) -> None:
        try:
            connect(raw, endpoint, self._key)
        except KouxingError:
            self.close_connection(raw)
            raise

    def _monitor(self, raw: Connection, on_refused: Callable[[bool], None]) -> None:
        """Report rejections: a server that rejects a key accepts the connection, then closes it."""
        monitor = raw.get_monitor_socket(_MONITORED)
        state = {"connected": False}

        def on_event(parts: list[bytes]) -> None:
            event = parse_monitor_message(parts)["event"]
            if event == zmq.EVENT_CONNECTED:
                state["connected"] = True
                return
            on_refused(event == zmq.EVENT_CONNECT_RETRIED and state["connected"])
            state["connected"] = False

        self._monitors[raw] = monitor
        self._handlers[monitor] = on_event
        self._poller.register(monitor, zmq.POLLIN)
