"""The sockets of one client, which one thread uses, and how other threads reach that thread."""

from __future__ import annotations

import contextlib
import math
import secrets
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from typing import Any, Protocol

import zmq

from kouxing_client.errors import KouxingError
from kouxing_client.keys import Key

QUEUE = 20_000  # messages
RECONNECT_MS = (50, 100)  # between attempts to connect, at first and later
HANDSHAKE_MS = 2000
STOPPED_S = 0.5  # a wait that is so much longer than asked for: this process was stopped


class Signal(Protocol):
    """Wakes who waits for a change."""

    def notify(self) -> None:
        """Something changed; for any thread."""


class Sockets:
    """All but ``call`` and ``make_signal`` is for the thread that calls ``step`` alone.

    Parameters
    ----------
    key
        Who this program is; None: nothing is encrypted.
    make_signal
        Makes what wakes who waits for a session or for results.
    """

    def __init__(self, key: Key | None, make_signal: Callable[[], Signal]) -> None:
        self.make_signal = make_signal
        self.went_on_s = -math.inf  # when it went on after this process had been stopped
        self._key = key
        self._context = zmq.Context()
        self._poller = zmq.Poller()
        self._handlers: dict[zmq.Socket[bytes], Callable[[list[bytes]], None]] = {}
        self._calls: deque[Callable[[], None]] = deque()
        self._woken, self._waker = socket.socketpair()
        self._woken.setblocking(False)
        self._waker.setblocking(False)
        self._poller.register(self._woken, zmq.POLLIN)

    def call(self, function: Callable[[], None]) -> None:
        """Let the thread call something; for any thread."""
        self._calls.append(function)
        with contextlib.suppress(OSError):  # full, so that it is awake; or closed
            self._waker.send(b"\0")

    def step(self, timeout_s: float) -> None:
        """Handle what has arrived and what is to be called, waiting up to the timeout for it."""
        begin_s = time.monotonic()
        ready = self._poller.poll(round(1000 * timeout_s))
        if time.monotonic() > begin_s + timeout_s + STOPPED_S:
            self.went_on_s = time.monotonic()
        for raw, _ in ready:
            if isinstance(raw, zmq.Socket):
                self.drain(raw)
        with contextlib.suppress(BlockingIOError):
            self._woken.recv(4096)
        while self._calls:
            self._calls.popleft()()

    def connect(
        self,
        kind: int,
        endpoints: Iterable[str],
        handler: Callable[[list[bytes]], None],
        *,
        queue: int = QUEUE,
        buffer: int = -1,
    ) -> zmq.Socket[bytes]:
        """Connect a socket.

        Parameters
        ----------
        kind
            ``zmq.DEALER`` or ``zmq.SUB``.
        endpoints
            An address each and, unless all is plain, a space and a public key.
        handler
            What to call with the parts of each message.
        queue
            Messages that may wait.
        buffer
            Bytes that the kernel may hold of what comes; -1: as it likes.

        Raises
        ------
        KouxingError
            If an endpoint is none.
        """
        raw: zmq.Socket[bytes] = self._context.socket(kind)
        raw.linger, raw.sndhwm, raw.rcvhwm = 0, queue, queue
        raw.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS[0])
        raw.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_MS[1])
        raw.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        raw.setsockopt(zmq.RCVBUF, buffer)
        if kind == zmq.DEALER:  # a router knows this peer again after a reconnect
            raw.setsockopt(zmq.ROUTING_ID, b"\1" + secrets.token_bytes(15))
        try:
            for endpoint in endpoints:
                self._connect(raw, endpoint)
        except KouxingError:
            raw.close()
            raise
        self._handlers[raw] = handler
        self._poller.register(raw, zmq.POLLIN)
        return raw

    def drain(self, raw: zmq.Socket[bytes]) -> None:
        """Handle what has arrived at a socket, until it is dropped."""
        with contextlib.suppress(zmq.Again):
            while (handler := self._handlers.get(raw)) is not None:
                handler(raw.recv_multipart(zmq.DONTWAIT))

    def drop(self, raw: zmq.Socket[bytes]) -> None:
        """Close a socket."""
        self._poller.unregister(raw)
        del self._handlers[raw]
        raw.close()

    def close(self) -> None:
        """Close all."""
        self._context.destroy(linger=0)
        self._woken.close()
        self._waker.close()

    def _connect(self, raw: zmq.Socket[bytes], endpoint: str) -> None:
        address, _, server = endpoint.partition(" ")
        if bool(server) != (self._key is not None):
            raise KouxingError(f"{address}: one end is encrypted, the other is 'insecure'")
        if self._key is not None:
            raw.setsockopt_string(zmq.CURVE_SERVERKEY, server)
            raw.setsockopt_string(zmq.CURVE_PUBLICKEY, self._key.public)
            raw.setsockopt_string(zmq.CURVE_SECRETKEY, self._key.secret)
        raw.setsockopt(zmq.IPV6, "[" in address)
        try:
            raw.connect(address)
        except zmq.ZMQError as error:
            raise KouxingError(f"cannot connect to {address!r}: {error.strerror}") from None


def send(raw: zmq.Socket[bytes], parts: list[bytes]) -> bool:
    """Return whether a socket took a message."""
    try:
        raw.send_multipart(parts, zmq.DONTWAIT)
    except zmq.Again:
        return False
    return True


def new_future() -> Future[Any]:
    """Return a future that who waits for it cannot cancel."""
    future: Future[Any] = Future()
    future.set_running_or_notify_cancel()
    return future
