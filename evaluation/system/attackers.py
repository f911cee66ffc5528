"""Attackers for `evaluate attacks`: ZeroMQ peers and web clients that break the rules.

Some have no key and never get past the handshake. The others have a client key that control
accepts. Each attack runs for a given time and connects from a given loopback address. A service can
therefore distinguish the attacker from the clients that it must continue to serve.
"""

import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random

import zmq
from kouxing_client import Refused
from kouxing_client.keys import Key

from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command import client_connection
from kouxing.shared.settings.keys import load_user_key

# The first bytes of ZeroMQ's wire protocol, ZMTP 3.0, and flags of its frames.
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
CURVE_GREETING = GREETING[:12] + b"CURVE".ljust(20, b"\0") + bytes(32)
LONG, COMMAND = 2, 4

LOCALHOST = "127.0.0.1"
BLOCK = b"x" * 65_536
NUM_CONNECTIONS = 1500
NUM_SILENT_SUBSCRIBERS = 100
BUSY_PROCESSOR = "busy processor"

AttackFunction = Callable[[str, str, float], None]
"""Takes an endpoint, the source address and a duration in seconds."""


@dataclass(frozen=True, slots=True)
class Attack:
    """One attack, and the sockets that it is run against."""

    run: AttackFunction
    targets: tuple[str, ...]
    has_key: bool = False


def ready_command(kind: str) -> bytes:
    """Return the READY command of a socket kind, such as ``DEALER``."""
    command = b"\x05READY\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind.encode()
    return bytes([COMMAND, len(command)]) + command


def connect(raw: zmq.Socket[bytes], endpoint: str, key: Key, source: str = "") -> None:
    """Connect a ZeroMQ socket to an endpoint, with a key if the endpoint names the server's key."""
    address, _, server_key = endpoint.partition(" ")
    if server_key:
        raw.curve_serverkey = server_key.encode()
        raw.curve_publickey, raw.curve_secretkey = key.public.encode(), key.secret.encode()
    raw.connect(address.replace("tcp://", f"tcp://{source}:0;") if source else address)


def spin(_endpoint: str, _source: str, seconds: float) -> None:
    """Keep one processor core busy. The attackers do that too, so this is the baseline."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        pass


# Attackers without a key.


def random_bytes(endpoint: str, source: str, seconds: float) -> None:
    """Open connections and send random bytes, some of them after a valid greeting."""
    random = Random(1)  # noqa: S311 - no secret
    starts = (
        b"",
        GREETING,
        GREETING + ready_command("DEALER"),
        CURVE_GREETING,
        b"GET / HTTP/1.1\r\n",
    )
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        with contextlib.suppress(OSError), _open_connection(endpoint, source) as connection:
            connection.settimeout(0.02)
            connection.sendall(random.choice(starts) + random.randbytes(random.choice((10, 10**4))))
            connection.recv(1000)


def half_open_connections(endpoint: str, source: str, seconds: float) -> None:
    """Hold many connections, each with an unfinished handshake or web request."""
    start = b"GET / HTTP/1.1\r\nHost: " if endpoint.startswith("http") else CURVE_GREETING[:40]
    end_s = time.monotonic() + seconds
    with many_connections(_port_of(endpoint), source) as connections:
        for connection in connections:
            with contextlib.suppress(OSError):  # closed by the peer
                connection.sendall(start)
        time.sleep(max(0.0, end_s - time.monotonic()))


def endless_handshake(endpoint: str, source: str, seconds: float) -> None:
    """Announce a command of a terabyte in the handshake, and send it as fast as possible."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        with contextlib.suppress(OSError), _open_connection(endpoint, source) as connection:
            connection.sendall(
                CURVE_GREETING + bytes([COMMAND | LONG]) + (2**40).to_bytes(8, "big")
            )
            while time.monotonic() < end_s:
                connection.sendall(BLOCK)


@contextlib.contextmanager
def many_connections(port: int, source: str) -> Iterator[list[socket.socket]]:
    """Hold TCP connections, fewer than all if the peer or this process's limit allows fewer."""
    with contextlib.ExitStack() as stack:
        connections = []
        with contextlib.suppress(OSError):
            for _ in range(NUM_CONNECTIONS):
                connection = socket.create_connection((LOCALHOST, port), 1.0, (source, 0))
                connections.append(stack.enter_context(connection))
        yield connections


def _open_connection(endpoint: str, source: str) -> socket.socket:
    return socket.create_connection((LOCALHOST, _port_of(endpoint)), 1.0, (source, 0))


def _port_of(endpoint: str) -> int:
    return int(endpoint.partition(" ")[0].rstrip("/").rpartition(":")[2])


# Attackers with a client key.


def _flood(make_message: Callable[[int], list[bytes]], kind: int = zmq.DEALER) -> AttackFunction:
    """Return an attack that sends messages as fast as the socket takes them."""

    def attack(endpoint: str, source: str, seconds: float) -> None:
        with zmq.Context() as context, context.socket(kind) as raw:
            raw.sndtimeo, raw.linger = 100, 0
            connect(raw, endpoint, load_user_key(), source)
            number, end_s = 0, time.monotonic() + seconds
            while time.monotonic() < end_s:
                with contextlib.suppress(zmq.Again):
                    raw.send_multipart(make_message(number))
                    number += 1

    return attack


def _random_message(number: int) -> list[bytes]:
    random = Random(number)  # noqa: S311 - no secret
    return [random.randbytes(random.choice((0, 1, 30, 3000))) for _ in range(random.randint(1, 4))]


def keyed_connections(endpoint: str, source: str, seconds: float) -> None:
    """Hold many ZeroMQ connections of one key."""
    end_s = time.monotonic() + seconds
    with zmq.Context() as context, contextlib.ExitStack() as stack:
        context.set(zmq.MAX_SOCKETS, NUM_CONNECTIONS + 10)
        with contextlib.suppress(zmq.ZMQError):  # this process's limit of open files
            while time.monotonic() < end_s:
                raw = stack.enter_context(context.socket(zmq.DEALER))
                raw.linger = 0
                connect(raw, endpoint, load_user_key(), source)
                raw.send(b"", zmq.NOBLOCK)
        time.sleep(max(0.0, end_s - time.monotonic()))


def silent_subscribers(control: str, source: str, seconds: float) -> None:
    """Subscribe to a session's frames many times and never read them.

    The session skips audio, which makes the synthesizer send many frames at once.
    """
    end_s = time.monotonic() + seconds
    with (
        client_connection.connect_client(control) as client,
        zmq.Context() as context,
        contextlib.ExitStack() as stack,
    ):
        session = client.open_session(paced=False)
        for _ in range(NUM_SILENT_SUBSCRIBERS):
            raw = stack.enter_context(context.socket(zmq.SUB))
            raw.rcvhwm, raw.rcvbuf, raw.linger = 1, 4096, 0
            connect(raw, session.info["faps"], load_user_key(), source)
            raw.subscribe(f"fap-frame/{session.name}/")
        while time.monotonic() < end_s:
            if session.try_push(bytes(640)):
                session.skip(round(9.9 * MEDIA_RATE_HZ))
            time.sleep(seconds / 60)
        session.close()


def many_sessions(control: str, _source: str, seconds: float) -> None:
    """Open sessions until control rejects one, and keep them."""
    end_s = time.monotonic() + seconds
    with client_connection.connect_client(control) as client:
        with contextlib.suppress(Refused):
            while time.monotonic() < end_s:
                client.open_session()
        time.sleep(max(0.0, end_s - time.monotonic()))


_INPUTS = ("commands", "audio")
ATTACKS: dict[str, Attack] = {
    BUSY_PROCESSOR: Attack(spin, ("",)),
    "random bytes": Attack(random_bytes, ("commands", "audio", "faps", "page")),
    "half-open connections": Attack(half_open_connections, ("commands", "audio", "faps", "page")),
    "endless handshake": Attack(endless_handshake, ("commands", "audio", "faps")),
    **{
        name: Attack(run, targets, has_key=True)
        for name, run, targets in (
            ("huge messages", _flood(lambda _: [bytes(64 * 2**20)]), _INPUTS),
            ("messages of many parts", _flood(lambda _: [bytes(300)] * 300_000), _INPUTS),
            ("flood of large messages", _flood(lambda _: [bytes(65_000)]), _INPUTS),
            ("flood of small messages", _flood(lambda _: [bytes(10)]), _INPUTS),
            ("malformed messages", _flood(_random_message), _INPUTS),
            ("many subscriptions", _flood(lambda n: [b"\x01%0120d" % n], zmq.XSUB), ("faps",)),
            ("many connections", keyed_connections, _INPUTS),
            ("silent subscribers", silent_subscribers, ("commands",)),
            ("many sessions", many_sessions, ("commands",)),
        )
    },
}
