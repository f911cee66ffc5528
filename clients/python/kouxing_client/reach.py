"""Finds out why an address cannot be reached, with the fix."""

import contextlib
import socket


def reach_error(host: str, port: str, timeout_s: float = 3.0, *, is_zeromq: bool = False) -> str:
    """Return why a TCP port, or a ZeroMQ socket, cannot be reached from here; empty if it can."""
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout_s) as connection:
            if is_zeromq and not _greets(connection):
                return (
                    "another program answers there, or kouxing hangs; correct the address, or"
                    " restart kouxing"
                )
    except TimeoutError:
        return "the connection times out; open this port in the firewalls between the machines"
    except ConnectionRefusedError:
        return "nothing listens there; start kouxing there (kouxing run), or correct the address"
    except (socket.gaierror, UnicodeError):  # UnicodeError: a label of the name is too long
        return f"the host name {host!r} is unknown; correct it, or write an IP address"
    except OSError as error:
        return f"{error.strerror}; check the address and the network"
    return ""


def _greets(connection: socket.socket) -> bool:
    """Return whether a peer sends the first byte of ZeroMQ's greeting."""
    with contextlib.suppress(OSError):
        return connection.recv(1) == b"\xff"
    return False
