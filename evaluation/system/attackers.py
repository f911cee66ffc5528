"""Hostile peers: of a socket, as ZeroMQ's wire protocol (ZMTP 3) lets them be, and of the page.

Those of ``ALLOWED`` have a key that is allowed, the others need none; none knows a session. Each
stops by itself, at the latest after the given time.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import zmq

from kouxing.shared.client import Client
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.keys import Key, user_key

MORE, LONG, COMMAND = 1, 2, 4  # flags of a frame
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
BLOCK_BYTES = 64 * 1024
NUM_SILENT = 100  # subscribers
TARGETS = {  # sockets of all kinds: their service, their setting, and the kind of their peers
    "commands": ("control", "COMMANDS", "DEALER"),
    "events": ("control", "EVENTS", "SUB"),
    "audio": ("recognizer", "AUDIO", "DEALER"),
    "phone_input": ("synthesizer", "PHONE_INPUT", "DEALER"),
    "faps": ("synthesizer", "FAPS", "SUB"),
}


def ready(kind: str) -> bytes:
    """Return what follows the greeting, of a socket of some kind."""
    command = b"\x05READY\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind.encode()
    return bytes([COMMAND, len(command)]) + command


def connected(port: int, kind: str = "DEALER", host: str = "127.0.0.1") -> socket.socket:
    """Return a connection that shook hands as a socket of some kind, without any key.

    ``host`` is the address that it comes from.

    Raises
    ------
    OSError
        If the other end refuses.
    """
    connection = socket.create_connection(("127.0.0.1", port), 5.0, (host, 0))
    try:
        connection.sendall(GREETING + ready(kind))
        answer = b""
        while len(answer) < len(GREETING) + 2:  # and the beginning of its READY
            received = connection.recv(1024)
            if not received:
                raise ConnectionResetError("the handshake is refused")
            answer += received
    except BaseException:
        connection.close()
        raise
    return connection


def frame(body: bytes, *, more: bool = False) -> bytes:
    """Return one part of a message as it is on the wire."""
    flags = MORE if more else 0
    if len(body) < 256:
        return bytes([flags, len(body)]) + body
    return bytes([flags | LONG]) + len(body).to_bytes(8, "big") + body


def flood(connection: socket.socket, block: bytes, seconds: float) -> int:
    """Send a block again and again until the other end has had enough; return how many bytes."""
    num_bytes, end_s = 0, time.monotonic() + seconds
    connection.settimeout(seconds)
    with contextlib.suppress(OSError):
        while time.monotonic() < end_s:
            num_bytes += connection.send(block)
    return num_bytes


def endless_message(port: int, kind: str, part: bytes, seconds: float) -> int:
    """Send a message that does not end."""
    one = frame(part, more=True)
    with connected(port, kind) as connection:
        return flood(connection, one * max(1, BLOCK_BYTES // len(one)), seconds)


def many_messages(port: int, kind: str, body: bytes, seconds: float) -> int:
    """Send messages that say nothing, as fast as they are taken."""
    one = frame(body)
    with connected(port, kind) as connection:
        return flood(connection, one * max(1, BLOCK_BYTES // len(one)), seconds)


def many_parts(port: int, kind: str, num_parts: int) -> int:
    """Send a message of very many empty parts that does end."""
    with connected(port, kind) as connection:
        return flood(connection, frame(b"", more=True) * num_parts + frame(b""), 1.0)


def many_subscriptions(port: int, num_bytes: int, seconds: float) -> int:
    """Subscribe to ever new topics of some length."""
    sent, number, end_s = 0, 0, time.monotonic() + seconds
    with connected(port, "SUB") as connection:
        connection.settimeout(seconds)
        with contextlib.suppress(OSError):
            while time.monotonic() < end_s:
                block = b"".join(
                    frame(b"\x01" + str(n).encode().rjust(num_bytes, b"x")[::-1])
                    for n in range(number, number + max(1, BLOCK_BYTES // num_bytes))
                )
                number += max(1, BLOCK_BYTES // num_bytes)
                connection.sendall(block)
                sent += len(block)
    return sent


@contextlib.contextmanager
def many_connections(port: int, num: int) -> Iterator[list[socket.socket]]:
    """Hold very many connections that never say anything."""
    with contextlib.ExitStack() as held:
        connections = []
        with contextlib.suppress(OSError):  # the own limit of open files, or refused
            for _ in range(num):
                connection = socket.create_connection(("127.0.0.1", port), timeout=5.0)
                connections.append(held.enter_context(connection))
        yield connections


Attack = Callable[[int, str, float], object]  # of a port, by a kind of peer, for some seconds


def _together(num: int, attack: Callable[[], object]) -> None:
    """Attack over several connections; where one is refused the others go on."""

    def one(_: int) -> None:
        with contextlib.suppress(OSError):
            attack()

    with ThreadPoolExecutor(num) as pool:
        list(pool.map(one, range(num)))


def _endless(part: bytes, num: int) -> Attack:
    return lambda port, kind, seconds: _together(
        num, lambda: endless_message(port, kind, part, seconds)
    )


def _flood(body: bytes, num: int) -> Attack:
    return lambda port, kind, seconds: _together(
        num, lambda: many_messages(port, kind, body, seconds)
    )


def _parts(port: int, kind: str, _seconds: float) -> None:
    _together(1, lambda: many_parts(port, kind, 200_000))


FLOODS: dict[str, Attack] = {
    "an endless message of large parts": _endless(b"x" * 65_536, 1),
    "an endless message of small parts": _endless(b"x" * 300, 1),
    "endless messages of empty parts": _endless(b"", 4),
    "a message of very many parts": _parts,
    "messages of 1 MiB": _flood(b"x" * 2**20, 4),
    "messages of the largest size": _flood(b"x" * 65_000, 4),
    "small messages": _flood(b"x" * 10, 1),
}


def _subscriptions(num_bytes: int) -> Attack:
    return lambda port, _kind, seconds: _together(
        12, lambda: many_subscriptions(port, num_bytes, seconds)
    )


SUBSCRIPTIONS = {
    "subscriptions of 1 MiB": _subscriptions(2**20),
    "very many subscriptions": _subscriptions(120),
}


def hold_connections(port: int, _kind: str, seconds: float) -> None:
    """Hold more connections than a process takes."""
    with many_connections(port, 1500):
        time.sleep(seconds)


def hold_half_requests(port: int, _kind: str, seconds: float) -> None:
    """Hold more half requests than a web server should."""
    with many_connections(port, 300) as connections:
        for connection in connections:
            with contextlib.suppress(OSError):  # refused meanwhile
                connection.sendall(b"GET / HTTP/1.1\r\nHost: ")
        time.sleep(seconds)


def hold_thousands(port: int, _kind: str, seconds: float) -> None:
    """Connect thousands of times."""
    with many_connections(port, 4000):
        time.sleep(seconds)


PAGE: dict[str, Attack] = {
    "300 half requests": hold_half_requests,
    "4000 connections": hold_thousands,
}

AllowedAttack = Callable[[str, float], None]  # of an endpoint, for some seconds


def connect(raw: zmq.Socket[bytes], endpoint: str, key: Key) -> None:
    """Connect a socket as any program does that has a key, where one is needed."""
    address, _, server_key = endpoint.partition(" ")
    if server_key:
        raw.curve_serverkey = server_key.encode()
        raw.curve_publickey, raw.curve_secretkey = key.public.encode(), key.secret.encode()
    raw.connect(address)


def never_read(control: str, seconds: float) -> None:
    """Let the frames of a session wait for subscribers that take none; gaps make very many."""
    with Client(control) as client, zmq.Context() as context, contextlib.ExitStack() as held:
        session = client.open_session(paced=False)
        for _ in range(NUM_SILENT):
            raw = held.enter_context(context.socket(zmq.SUB))
            raw.rcvhwm, raw.rcvbuf, raw.linger = 1, 4096, 0
            connect(raw, session.opened.faps, user_key())
            raw.subscribe(f"fap-frame/{session.name}/")
        time.sleep(seconds / 4)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            if session.send(np.zeros(320, np.int16)):
                session.skip(round(9.9 * MEDIA_RATE_HZ))
            time.sleep(seconds / 60)
        session.close()


SESSIONS: dict[str, AllowedAttack] = {"subscribers that never read": never_read}  # at control


def _sends(kind: int, part: bytes, num_parts: int = 1) -> AllowedAttack:
    """Return an attack that sends the same message again and again, or ever new subscriptions.

    ZeroMQ sends no message that is not complete, so that one without end is not among them.
    """

    def attack(endpoint: str, seconds: float) -> None:
        with zmq.Context() as context, context.socket(kind) as raw:
            raw.sndtimeo, raw.linger = 100, int(1000 * seconds)
            connect(raw, endpoint, user_key())
            number, end_s = 0, time.monotonic() + seconds
            while time.monotonic() < end_s:
                number += 1
                last = part + (b"%08d" % number if kind == zmq.XSUB else b"")
                with contextlib.suppress(zmq.Again):
                    raw.send_multipart([part] * (num_parts - 1) + [last])

    return attack


ALLOWED = {  # by a key that is allowed
    f"with a key: {name}": attack
    for name, attack in {
        "a message of 2500 large parts": _sends(zmq.DEALER, b"x" * 60_000, 2500),
        "a message of 300000 small parts": _sends(zmq.DEALER, b"x" * 300, 300_000),
        "messages of 100000 empty parts": _sends(zmq.DEALER, b"", 100_000),
        "messages of the largest size": _sends(zmq.DEALER, b"x" * 65_000),
        "small messages": _sends(zmq.DEALER, b"x" * 10),
        "very many subscriptions": _sends(zmq.XSUB, b"\x01" + b"x" * 110),
    }.items()
}
