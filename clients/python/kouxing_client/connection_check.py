"""Returns the reason why an address cannot be reached, and how to fix it."""

import contextlib
import queue
import socket
import threading
from collections.abc import Callable
from typing import Any

LookUp = Callable[..., list[tuple[Any, ...]]]
NO_LISTENER = "nothing listens there; start kouxing there (kouxing run), or correct the address"


def explain_unreachable(
    host: str,
    port: str,
    timeout_s: float = 3.0,
    *,
    is_zeromq: bool = False,
    look_up: LookUp = socket.getaddrinfo,
) -> str:
    """Return why a TCP port, or a ZeroMQ socket, cannot be reached from here; empty if it can.

    ``timeout_s`` limits the look-up of the name, and the connection to each of its addresses.
    """
    host = host.strip("[]")
    try:
        addresses = _look_up(look_up, host, int(port), timeout_s)
    except (socket.gaierror, UnicodeError):  # UnicodeError: a label of the name is too long
        return f"the host name {host!r} is unknown; correct it, or write an IP address"
    except queue.Empty:
        return (
            f"no name server answers for the host name {host!r}; check the network,"
            " or write an IP address"
        )
    except OSError as error:
        return _reason_for(error)
    families = {family for family, *_ in addresses}
    if is_zeromq and ":" not in host and families == {socket.AF_INET6}:
        return (
            f"the host name {host!r} has no IPv4 address; write its IPv6 address in brackets:"
            f" [{addresses[0][4][0]}]"
        )
    reason = ""
    for family, kind, protocol, _, address in addresses:
        try:
            with socket.socket(family, kind, protocol) as connection:
                connection.settimeout(timeout_s)
                connection.connect(address)
                if not is_zeromq or _sends_greeting(connection):
                    return ""
                reason = (
                    "another program answers there, or kouxing hangs; correct the address, or"
                    " restart kouxing"
                )
        except OSError as error:
            reason = reason or _reason_for(error)
    return reason


def _look_up(look_up: LookUp, host: str, port: int, timeout_s: float) -> list[tuple[Any, ...]]:
    """Return the addresses of a host. Raises ``queue.Empty`` after the limit."""
    answers: queue.SimpleQueue[list[tuple[Any, ...]] | Exception] = queue.SimpleQueue()

    def run() -> None:
        try:
            answers.put(look_up(host, port, type=socket.SOCK_STREAM))
        except Exception as error:
            answers.put(error)

    threading.Thread(target=run, daemon=True).start()  # it cannot be interrupted
    answer = answers.get(timeout=timeout_s)
    if isinstance(answer, Exception):
        raise answer
    return answer


def _reason_for(error: OSError) -> str:
    if isinstance(error, TimeoutError):
        return "the connection times out; open this port in the firewalls between the machines"
    if isinstance(error, ConnectionRefusedError):
        return NO_LISTENER
    return f"{error.strerror}; check the address and the network"


def _sends_greeting(connection: socket.socket) -> bool:
    """Return whether a peer sends the first byte of ZeroMQ's greeting."""
    with contextlib.suppress(OSError):
        return connection.recv(1) == b"\xff"
    return False
