"""Invalid bytes for ports of any kind: ZeroMQ, HTTP, WebSockets."""

import contextlib
import socket
import time
from random import Random

from kouxing.evaluation.system import attackers


def pour(port: int, seconds: float) -> None:
    """Send invalid bytes over many connections, the same ones in every run."""
    random = Random(1)  # noqa: S311
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", port), timeout=0.02) as connection,
        ):
            for _ in range(random.choice([1, 1, 20])):
                connection.sendall(_nonsense(random))
            connection.recv(1000)


def answer_handshake(listener: socket.socket, curve: bool, rest: bytes) -> None:
    """Answer a ZeroMQ socket like another program or one with other keys, then free the port."""
    greeting = attackers.GREETING
    if curve:
        greeting = greeting[:12] + b"CURVE".ljust(20, b"\0") + greeting[32:]
    with listener, listener.accept()[0] as connection, contextlib.suppress(OSError):
        connection.sendall(greeting + rest)
        while connection.recv(1000):  # until the peer gives up
            pass


def _nonsense(random: Random) -> bytes:
    """Return random bytes after the first bytes of a valid message."""
    beginnings = [
        b"",
        attackers.GREETING,
        attackers.GREETING + attackers.ready("DEALER"),
        attackers.GREETING + attackers.ready("SUB"),
        attackers.GREETING[:12] + b"CURVE".ljust(20, b"\0") + bytes(32),
        b"\xff" + bytes(8) + b"\x7f\x01\x05",
        b"\x01\x00",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffff\r\n",
        b"\x16\x03\x01",
    ]
    return random.choice(beginnings) + random.randbytes(random.choice([1, 10, 100, 10_000]))
