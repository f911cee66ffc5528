"""Queries the kernel about libzmq's sockets: addresses and byte counts, by file descriptor."""

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
from typing import NamedTuple

_IS_LINUX = sys.platform == "linux"
# struct tcp_info: tcpi_bytes_acked, tcpi_bytes_received, tcpi_notsent_bytes
_COUNTERS = struct.Struct("120x2Q8xI")
_RESET = struct.pack("ii", 1, 0)  # struct linger: on, no time
_DISCARD = getattr(socket, "MSG_DONTWAIT", 0) | socket.MSG_TRUNC
_SINK = bytearray(1024 * 1024)


class Traffic(NamedTuple):
    """Byte counts of one connection; all 0 where the kernel does not report them."""

    read: int = 0
    """received bytes that this process has read"""
    acknowledged: int = 0
    """sent bytes that the peer's kernel has accepted"""
    unsent: int = 0
    """bytes that wait because the peer's kernel accepts no more"""


def get_inode(descriptor: int) -> int | None:
    """Return the inode of the socket behind a descriptor, None if it is not a socket."""
    try:
        status = os.fstat(descriptor)
    except OSError:
        return None
    return status.st_ino if stat.S_ISSOCK(status.st_mode) else None


def get_peer_address(descriptor: int) -> str:
    """Return the peer's network (see ``get_network``), empty if the peer is gone."""
    with contextlib.suppress(OSError), _borrow_socket(descriptor) as connection:
        return get_network(str(connection.getpeername()[0]))
    return ""


def get_local_port(descriptor: int) -> int:
    """Return the local port, or 0 if the socket has no port."""
    with contextlib.suppress(OSError), _borrow_socket(descriptor) as connection:
        name = connection.getsockname()
        return int(name[1]) if isinstance(name, tuple) else 0
    return 0


def get_network(host: str) -> str:
    """Return one name for all addresses that a host controls.

    Loopback addresses become "loopback" and an IPv6 address its /64 network. Returns an empty
    string if ``host`` is not an IP address.
    """
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return ""
    if address.version == 6:
        address = address.ipv4_mapped or address
    if address.is_loopback:
        return "loopback"
    prefix = 64 if address.version == 6 else 32
    return str(ipaddress.ip_network((address, prefix), strict=False).network_address)


def get_traffic(descriptor: int) -> Traffic:
    """Return the byte counts of a TCP connection. Only Linux reports them."""
    if not _IS_LINUX:
        return Traffic()
    try:
        connection = socket.SocketType(socket.AF_INET, socket.SOCK_STREAM, 0, descriptor)
        try:
            info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _COUNTERS.size)
        finally:
            connection.detach()
        acknowledged, received, unsent = _COUNTERS.unpack(info)
        (unread,) = struct.unpack("i", fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)))
        return Traffic(received - unread, acknowledged, unsent)
    except (OSError, struct.error):  # closed
        return Traffic()


def reset(descriptor: int, inode: int) -> None:
    """Reset a connection, unless the descriptor has been reused. Any thread may call this."""
    if (connection := _copy(descriptor, inode)) is not None:
        with connection:
            _shut_down(connection, socket.SHUT_RDWR)


def hold(descriptor: int, inode: int) -> socket.socket | None:
    """Make libzmq close a connection, but keep it open for the peer.

    Closing the returned socket resets the connection. Returns None if the descriptor is closed or
    reused.
    """
    if (connection := _copy(descriptor, inode)) is not None:
        _shut_down(connection, socket.SHUT_RD)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the kernel's minimum
    return connection


def _copy(descriptor: int, inode: int) -> socket.socket | None:
    """Return a copy that libzmq cannot close, None if the descriptor is closed or reused."""
    with contextlib.suppress(OSError):
        connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, os.dup(descriptor))
        if get_inode(connection.fileno()) == inode:
            return connection
        connection.close()
    return None


def _shut_down(connection: socket.socket, how: int) -> None:
    """Make libzmq close a connection, which is reset when its last descriptor is closed."""
    with contextlib.suppress(OSError):  # closed already
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        connection.shutdown(how)
        while connection.recv_into(_SINK, 0, _DISCARD):  # otherwise libzmq would read the data
            pass


@contextlib.contextmanager
def _borrow_socket(descriptor: int) -> Iterator[socket.socket]:
    """Yield a Python socket for a descriptor that libzmq owns."""
    connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, fileno=descriptor)
    try:
        yield connection
    finally:
        connection.detach()
