"""Raw bytes for the ports of services: invalid ones, and ZeroMQ's own."""

import contextlib
import socket
import time
from random import Random

from kouxing.evaluation.system.attackers import GREETING, LOCALHOST, LONG, ready_command
from tests.system import LIMIT_S

MORE = 1  # flag of a frame


def flood(port: int, seconds: float) -> None:
    """Send invalid bytes over many connections, the same ones in every run."""
    random = Random(1)  # noqa: S311
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", port), timeout=0.02) as connection,
        ):
            for _ in range(random.choice([1, 1, 20])):
                connection.sendall(_invalid_bytes(random))
            connection.recv(1000)


def answer_handshake(listener: socket.socket, curve: bool, rest: bytes) -> None:
    """Answer a ZeroMQ socket like another program or one with other keys, then free the port."""
    greeting = GREETING
    if curve:
        greeting = greeting[:12] + b"CURVE".ljust(20, b"\0") + greeting[32:]
    with listener, listener.accept()[0] as connection, contextlib.suppress(OSError):
        connection.sendall(greeting + rest)
        while connection.recv(1000):  # until the peer gives up
            pass


def _invalid_bytes(random: Random) -> bytes:
    """Return random bytes after the first bytes of a valid message."""
    beginnings = [
        b"",
        GREETING,
        GREETING + ready_command("DEALER"),
        GREETING + ready_command("SUB"),
        GREETING[:12] + b"CURVE".ljust(20, b"\0") + bytes(32),
        b"\xff" + bytes(8) + b"\x7f\x01\x05",
        b"\x01\x00",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffff\r\n",
        b"\x16\x03\x01",
    ]
    return random.choice(beginnings) + random.randbytes(random.choice([1, 10, 100, 10_000]))


def connect_raw(port: int, kind: str = "DEALER", host: str = LOCALHOST) -> socket.socket:
    """Connect from ``host`` to a port of this machine, with the handshake of a socket without keys.

    ``kind`` is ZeroMQ's name of the socket kind. Raises OSError if the other end refuses.
    """
    connection = socket.create_connection((LOCALHOST, port), LIMIT_S, (host, 0))
    try:
        connection.sendall(GREETING + ready_command(kind))
        answer = b""
        while len(answer) < len(GREETING) + 2:  # up to the start of the peer's READY
            received = connection.recv(1024)
            if not received:
                raise ConnectionResetError("the peer rejected the handshake")
            answer += received
    except BaseException:
        connection.close()
        raise
    return connection


def frame(body: bytes, *, more: bool = False) -> bytes:
    """Return one message part as it is on the wire."""
    flags = MORE if more else 0
    if len(body) < 256:
        return bytes([flags, len(body)]) + body
    return bytes([flags | LONG]) + len(body).to_bytes(8, "big") + body
