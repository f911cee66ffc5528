"""What the kernel says of a socket of libzmq's, by its descriptor."""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import os
import socket
import stat
import struct
import sys
import termios
from collections.abc import Iterator

SEES_BYTES = sys.platform == "linux"  # how many bytes came and went
# where struct tcp_info has tcpi_bytes_acked and tcpi_bytes_received
_BYTES_ACKED, _BYTES_RECEIVED = 120, 128


def inode_of(descriptor: int) -> int | None:
    """Return the number of the socket that a descriptor stands for, None if it is no socket."""
    try:
        status = os.fstat(descriptor)
    except OSError:
        return None
    return status.st_ino if stat.S_ISSOCK(status.st_mode) else None


def address_of(descriptor: int) -> str:
    """Return the other end's address, empty if it is gone.

    All that one host has at its hand counts as one: loopback, and an IPv6 network.
    """
    with contextlib.suppress(OSError), borrowed(descriptor) as connection:
        return network_of(str(connection.getpeername()[0]))
    return ""


def port_of(descriptor: int) -> int:
    """Return the port of this end, 0 if it has none."""
    with contextlib.suppress(OSError), borrowed(descriptor) as connection:
        name = connection.getsockname()
        return int(name[1]) if isinstance(name, tuple) else 0
    return 0


def network_of(host: str) -> str:
    """Return what counts as one with a host: "loopback", an IPv6 network; else itself."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:  # the other end is gone
        return ""
    if address.version == 6:
        address = address.ipv4_mapped or address
    if address.is_loopback:
        return "loopback"
    prefix = 64 if address.version == 6 else 32
    return str(ipaddress.ip_network((address, prefix), strict=False).network_address)


def bytes_read(descriptor: int) -> tuple[int, int]:
    """Return how many bytes libzmq has read at least, and at most; the kernel has others still."""
    with contextlib.suppress(OSError):
        before = tcp_figure(descriptor, _BYTES_RECEIVED)
        waiting = _kernel_figure(descriptor, termios.FIONREAD)
        return before - waiting, tcp_figure(descriptor, _BYTES_RECEIVED) - waiting
    return 0, 0


def bytes_taken(descriptor: int) -> tuple[int, int]:
    """Return how many bytes the peer has acknowledged, and how many it has still to."""
    with contextlib.suppress(OSError):
        waiting = _kernel_figure(descriptor, termios.TIOCOUTQ)
        return tcp_figure(descriptor, _BYTES_ACKED), waiting
    return 0, 0


def tcp_figure(descriptor: int, offset: int) -> int:
    """Return a 64-bit figure of struct tcp_info."""
    with borrowed(descriptor) as connection:
        info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, offset + 8)
    return int(struct.unpack_from("Q", info, offset)[0])


def _kernel_figure(descriptor: int, request: int) -> int:
    return int(struct.unpack("i", fcntl.ioctl(descriptor, request, bytes(4)))[0])


@contextlib.contextmanager
def borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Yield a socket of Python for a descriptor that stays libzmq's."""
    connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, fileno=descriptor)
    try:
        yield connection
    finally:
        connection.detach()
