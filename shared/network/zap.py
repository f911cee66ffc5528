"""The ZAP handler (ZeroMQ RFC 27), which checks the key of each new connection.

pyzmq's ``zmq.auth`` is not used: it always rejects with status 400, after which a peer does not
retry.
"""

import threading
from collections.abc import Callable, Collection

import zmq
from zmq.utils import z85

from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.network.kernel_sockets import get_network
from kouxing.shared.settings.keys import Grant, Grants, grants_file, read_grants


class Zap:
    """The keys that may connect to this process's sockets; reloaded after every change.

    ``required_roles`` has the role that a key needs, by the configuration key of the socket. Every
    allowed key may connect to the other sockets. ``disconnect`` is called with the keys that were
    revoked or have other roles now. Raises the errors of ``read_grants``.
    """

    def __init__(self, disconnect: Callable[[Collection[str]], None]) -> None:
        self._file = grants_file()
        self.version = self._newest_version()
        self.grants: Grants = read_grants()
        self.required_roles: dict[str, str] = {}
        self._disconnect = disconnect
        self._lock = threading.Lock()

    def refresh(self) -> None:
        """Read the list again if it has changed."""
        with self._lock:  # concurrent callers also wait for the new list
            version = self._newest_version()
            if version == self.version:
                return
            before = self.grants
            try:
                self.grants = read_grants()
            except UserError as error:
                LOG.error("keeping the previous list of allowed keys: %s", error)
            self.version = version
        self._disconnect_changed(before)

    def allow(self, grants: Grants) -> None:
        """Use these keys until the file changes."""
        with self._lock:
            before, self.grants = self.grants, grants
        self._disconnect_changed(before)

    def _disconnect_changed(self, before: Grants) -> None:
        self._disconnect({key for key, grant in before.items() if self.grants.get(key) != grant})

    def _newest_version(self) -> tuple[int, int]:
        try:
            about = self._file.stat()
        except OSError:
            return 0, 0
        return about.st_ino, about.st_mtime_ns

    def is_service(self, public: str) -> bool:
        """Return whether a key belongs to a service."""
        grant = self.grants.get(public)
        return grant is not None and _has_role(grant, "service")

    def may_connect(self, public: str, domain: str) -> bool:
        """Return whether a key may connect to a socket, given its configuration key."""
        self.refresh()
        grant = self.grants.get(public)
        if grant is None:
            return False
        required = self.required_roles.get(domain)
        return required is None or _has_role(grant, required)


def _has_role(grant: Grant, name: str) -> bool:
    return any(role.partition(":")[0] == name for role in grant.roles)


def answer_handshakes(
    context: zmq.Context[zmq.Socket[bytes]], zap: Zap | None, is_blocked: Callable[[str], bool]
) -> None:
    """Start a thread that answers libzmq's requests until the context ends.

    A rejection is temporary (status 300), so that the peer retries: its key may be allowed later. A
    key or, without keys, an address cannot connect while ``is_blocked`` holds for it.
    """
    socket = context.socket(zmq.REP)
    socket.bind("inproc://zeromq.zap.01")

    def may_connect(address: str, domain: str, key: str) -> bool:
        if zap is None:
            return not is_blocked(get_network(address))
        return not is_blocked(key) and zap.may_connect(key, domain)

    def answer() -> None:
        with socket:
            while True:
                try:
                    parts = socket.recv_multipart()
                except zmq.ContextTerminated:
                    return
                _version, request, domain, address, _identity, _mechanism, *keys = parts
                public = z85.encode(keys[0]) if keys else b""  # without encryption
                is_allowed = may_connect(address.decode(), domain.decode(), public.decode())
                reply = (b"200", b"", public) if is_allowed else (b"300", b"not allowed", b"")
                socket.send_multipart([b"1.0", request, *reply, b""])

    threading.Thread(target=answer, name="zap", daemon=True).start()
