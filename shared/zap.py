"""Says which keys may connect to this process's sockets: the ZAP handler (ZeroMQ RFC 27)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection

import zmq
from zmq.utils import z85

from kouxing.shared.errors import UserError
from kouxing.shared.kernel_sockets import network_of
from kouxing.shared.keys import Guests, guests_file, read_guests
from kouxing.shared.logs import LOG


class Zap:
    """The keys that may connect.

    Parameters
    ----------
    cut
        Ends the connections of keys that are allowed no longer, or not for the same.

    Attributes
    ----------
    guests
        Who may connect, by public key; read again whenever the list has changed.
    version
        Of the list.
    required_roles
        Role that a key needs, by setting of the socket; any allowed key may connect to the others.

    Raises
    ------
    UserError
        As ``read_guests``.
    """

    def __init__(self, cut: Callable[[Collection[str]], None]) -> None:
        self._file = guests_file()
        self.version = self._newest_version()
        self.guests: Guests = read_guests()
        self.required_roles: dict[str, str] = {}
        self._cut = cut
        self._lock = threading.Lock()

    def refresh(self) -> None:
        """Let changes of the list take effect."""
        with self._lock:  # whoever comes second has the new list, too
            version = self._newest_version()
            if version == self.version:
                return
            before = self.guests
            try:
                self.guests = read_guests()
            except UserError as error:
                LOG.error("the allowed keys stay as they were: %s", error)
            self.version = version
        self._cut_changed(before)

    def allow(self, guests: Guests) -> None:
        """Let these connect and no others, until the file changes."""
        with self._lock:
            before, self.guests = self.guests, guests
        self._cut_changed(before)

    def _cut_changed(self, before: Guests) -> None:
        self._cut({key for key, guest in before.items() if self.guests.get(key) != guest})

    def _newest_version(self) -> tuple[int, int]:
        try:
            about = self._file.stat()
        except OSError:
            return 0, 0
        return about.st_ino, about.st_mtime_ns

    def may_connect(self, public: str, domain: str) -> bool:
        """Return whether a key may connect to the socket of some setting."""
        self.refresh()
        guest = self.guests.get(public)
        if guest is None:
            return False
        wanted = self.required_roles.get(domain)
        return wanted is None or any(role.partition(":")[0] == wanted for role in guest.roles)


def answer_handshakes(
    context: zmq.Context[zmq.Socket[bytes]],
    zap: Zap | None,
    is_blocked: Callable[[str], bool],
) -> None:
    """Answer libzmq on a thread of its own, until the context ends.

    A refusal is a temporary one (status 300): who is refused tries again, for the key, or the
    address, may be allowed any moment.

    Parameters
    ----------
    context
        Of the sockets.
    zap
        Says which keys may connect; None: all is plain.
    is_blocked
        Returns whether a key or, without keys, an address cannot connect for now.
    """
    socket = context.socket(zmq.REP)
    socket.bind("inproc://zeromq.zap.01")

    def may_connect(address: str, domain: str, key: str) -> bool:
        if zap is None:
            return not is_blocked(network_of(address))
        return not is_blocked(key) and zap.may_connect(key, domain)

    def answer() -> None:
        with socket:
            while True:
                try:
                    parts = socket.recv_multipart()
                except zmq.ContextTerminated:
                    return
                _version, request, domain, address, _identity, _mechanism, *keys = parts
                public = z85.encode(keys[0]) if keys else b""  # none where all is plain
                is_guest = may_connect(address.decode(), domain.decode(), public.decode())
                reply = (b"200", b"", public) if is_guest else (b"300", b"not allowed", b"")
                socket.send_multipart([b"1.0", request, *reply, b""])

    threading.Thread(target=answer, name="zap", daemon=True).start()
