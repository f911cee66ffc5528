"""Limits the connections to the bound sockets of a process.

libzmq limits the size of a message part and the length of a queue. It does not limit the number
of connections, the number of parts of a message, or the rate of a peer. It keeps all parts of a
message until the last part arrives. Therefore, a thread checks every connection within 50 ms after
data arrives, and at least once a second. It compares the bytes that the kernel received (Linux
only) with the delivered messages. Until it is clear which bytes belong to an incomplete message,
it checks 20 times a second. It disconnects a peer that exceeds a limit, so that libzmq frees the
peer's memory. A well-behaved client is never disconnected, at any speed: its queue fills up,
libzmq stops reading, and the client waits.
"""

from __future__ import annotations

import contextlib
import math
import resource
import struct
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import partial

import zmq

from kouxing.shared.monitoring.metrics import trim_heap
from kouxing.shared.network import kernel_sockets
from kouxing.shared.network.peer_connection import PENALTY_S, PeerConnection
from kouxing.shared.network.peer_quota import BUDGET, MIN_BUDGET, PeerBudget, PeerQuota
from kouxing.shared.network.socket_limits import KIB, SocketLimits
from kouxing.shared.network.tarpit import MAX_HELD_CONNECTIONS, Tarpit
from kouxing.shared.network.waker import DescriptorWaiter, Waker

MIB = 1024 * KIB
CHECK_INTERVAL_S = 0.05  # interval between checks of all connections while data arrives
MAX_INTERVAL_S = 1.0  # interval between checks without new data
RECEIVE_BUFFER_BYTES = 256 * KIB  # in the kernel, which doubles it
MAX_UNDELIVERED_BYTES = 24 * MIB  # limit for all connections together
MAX_INCOMPLETE_BYTES = MIB  # limit for all connections together: 16 audio messages on slow links
EXTRA_INCOMPLETE_BYTES = 4 * KIB  # additional limit for each connection
MAX_UNREAD_MESSAGES = 200_000  # queued for all peers; about 100 bytes of memory each
NUM_NEW_CHECKS = 20  # checks in which a connection is new; a flood is disconnected earlier
MAX_ENDED_CONNECTIONS = 1024  # that a service has not handled yet
MAX_SUBSCRIPTION_BYTES = 128
MAX_TOPICS_BYTES = 32 * KIB  # of a connection's subscriptions: 64 sessions
MAX_ALL_TOPICS_BYTES = 192 * KIB  # of all connections; libzmq takes up to 120 times as much memory
MAX_FILES_MACOS = 10240  # OPEN_MAX: macOS allows less than it reports
TRIMS_S = (0.2, 1.0, 3.0)  # delays after a disconnect, because libzmq frees memory later
NUM_ENDED_BEFORE_TRIM = 50  # connections, about 1 MB; freeing memory takes up to 60 ms
_EVENTS = zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED  # events that a monitor reports
_READABLE = int(zmq.POLLIN)
_EVENT = struct.Struct("=HI")  # a monitor's event and descriptor


class LimitedSocket:
    """The connections to one bound socket."""

    def __init__(
        self, limiter: ConnectionLimiter, limits: SocketLimits, monitor: zmq.Socket[bytes]
    ) -> None:
        self.limits = limits
        self.port = 0  # 0 until it is bound
        self.num_sent = 0  # messages, to all peers
        self.num_polls = 0  # times that all complete messages had been delivered
        self.ended: deque[int] = deque(maxlen=MAX_ENDED_CONNECTIONS)  # inodes of ended connections
        self.limiter = limiter
        self._monitor = monitor

    def count_delivery(self, descriptor: int, key: str) -> PeerConnection | None:
        """Count a delivered message; return its connection, or None if the connection has ended.

        ``key`` is the public key of the sender, empty without encryption.
        """
        connection = self.limiter.find(descriptor, self)
        if connection is None:
            return None
        if not connection.num_delivered:
            connection.key = key
            self.limiter.restore_budget(connection)
        connection.num_delivered += 1
        if self.limits.cost:
            connection.spend(self.limits.cost)
        return connection

    def subscribe(self, connection: PeerConnection, topic: bytes) -> None:
        """Add a subscription; disconnect a peer with too many or too long subscriptions."""
        if len(topic) > MAX_SUBSCRIPTION_BYTES:
            connection.disconnect("a subscription is too long", PENALTY_S)
            return
        connection.topics.add(topic)
        if connection.topic_bytes > MAX_TOPICS_BYTES:
            connection.disconnect("it has too many subscriptions", PENALTY_S)
        self.limiter.limit_topics(len(topic))

    def disconnect_stalled(self, topics: Collection[bytes]) -> None:
        """Disconnect the subscribers to any of ``topics`` that stopped reading."""
        now_s = time.monotonic()
        for connection in self.limiter.connections_to(self):
            prefixes = tuple(connection.topics)
            follows = any(topic.startswith(prefixes) for topic in topics)
            if follows and connection.is_stalled(now_s):
                connection.disconnect("it stopped reading live frames")

    def accepted(self) -> Iterator[int]:
        """Yield the descriptors of new connections."""
        while int(self._monitor.get(zmq.EVENTS)) & _READABLE:
            data, _endpoint = self._monitor.recv_multipart()
            event, descriptor = _EVENT.unpack(data)
            if event == zmq.EVENT_ACCEPTED:
                yield descriptor

    def close(self) -> None:
        """Stop watching the socket."""
        self._monitor.close(linger=0)


class ConnectionLimiter:
    """Watches the connections to all bound sockets of a process.

    For ``is_service`` and ``extra_connections``, see ``PeerQuota``.
    """

    def __init__(self, is_service: Callable[[str], bool], extra_connections: int = 0) -> None:
        self._quota = PeerQuota(extra_connections, is_service)
        self._tarpit = Tarpit(min(MAX_HELD_CONNECTIONS, 4 * self._quota.max_clients))
        self._connections: dict[int, PeerConnection] = {}  # by inode; both threads add
        self._budgets: dict[str, PeerBudget] = {}  # budgets of owners whose connections ended
        self._sockets: list[LimitedSocket] = []
        self._has_undelivered = False  # bytes that may belong to a complete message
        self._topic_bytes = 0  # at most; the socket's thread only
        self._trims_s: list[float] = []  # when to give memory back
        self._num_ended = 0  # connections that ended since memory was last freed
        self._descriptor_waiter = DescriptorWaiter()
        self.waker: Waker | None = None  # wakes the loop that receives the messages
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="connections", daemon=True)

    def __len__(self) -> int:
        return len(self._connections)

    def limit(self, raw: zmq.Socket[bytes], limits: SocketLimits) -> LimitedSocket:
        """Set the limits of a socket that is not bound yet, and watch its connections."""
        raw.setsockopt(zmq.MAXMSGSIZE, limits.part_bytes)
        raw.setsockopt(zmq.RCVHWM, limits.queue_length)
        raw.setsockopt(zmq.RCVBUF, RECEIVE_BUFFER_BYTES)
        monitor = raw.get_monitor_socket(_EVENTS)
        self._descriptor_waiter.add(int(monitor.getsockopt(zmq.FD)))
        socket = LimitedSocket(self, limits, monitor)
        self._sockets.append(socket)
        if not self._thread.is_alive():
            self._thread.start()
        return socket

    def find(self, descriptor: int, socket: LimitedSocket) -> PeerConnection | None:
        """Return the connection of a descriptor, None if it is closed or reused."""
        inode = kernel_sockets.get_inode(descriptor)
        known = None if inode is None else self._connections.get(inode)
        if known is not None or inode is None:
            return known
        if kernel_sockets.get_local_port(descriptor) != socket.port:
            return None
        connection = self._connections.setdefault(inode, PeerConnection(descriptor, inode, socket))
        self._descriptor_waiter.add(descriptor)
        return connection

    def is_open(self, inode: int) -> bool:
        """Return whether a connection is still open."""
        connection = self._connections.get(inode)
        return connection is not None and _exists(connection)

    def connections_to(self, socket: LimitedSocket) -> list[PeerConnection]:
        """Return the connections to one socket."""
        connections = list(self._connections.values())
        return [c for c in connections if c.socket is socket and not c.is_disconnected]

    def restore_budget(self, connection: PeerConnection) -> None:
        """Give a new connection the remaining budget of its owner."""
        if (kept := self._budgets.get(connection.owner)) is not None:
            connection.budget = PeerBudget(max(MIN_BUDGET, kept.left))

    def save_budget(self, connection: PeerConnection) -> None:
        """Save the remaining budget of a connection for the owner's next connections."""
        saved = self._budgets.get(connection.owner)
        if connection.budget.left < (BUDGET if saved is None else saved.left):
            self._budgets[connection.owner] = connection.budget

    def limit_topics(self, num_bytes: int) -> None:
        """Count a subscription; above the total limit, disconnect the largest subscribers."""
        self._topic_bytes += num_bytes
        if self._topic_bytes > MAX_ALL_TOPICS_BYTES:
            self._topic_bytes = _disconnect_heaviest(
                list(self._connections.values()),
                lambda connection: connection.topic_bytes,
                MAX_ALL_TOPICS_BYTES,
                "there are too many subscriptions",
            )

    def disconnect_keys(self, keys: Collection[str]) -> None:
        """Disconnect the peers with the given keys."""
        for connection in list(self._connections.values()):
            if connection.key in keys:
                connection.disconnect("its key was revoked or has other roles now")

    def is_blocked(self, owner: str) -> bool:
        """Return whether a key or an address is temporarily blocked."""
        saved = self._budgets.get(owner)
        return saved is not None and saved.left < 0

    def close(self) -> None:
        """Stop watching."""
        if self._thread.is_alive():
            self._is_closing.set()
            self._descriptor_waiter.close()
            self._thread.join()
        self._tarpit.close()
        for socket in self._sockets:
            socket.close()

    def _run(self) -> None:
        while not self._is_closing.wait(CHECK_INTERVAL_S):
            now_s = time.monotonic()
            self.enforce_limits(now_s)
            if not self._has_undelivered:
                due_s = self._trims_s[0] if self._trims_s else math.inf
                self._descriptor_waiter.wait(min(due_s - now_s, MAX_INTERVAL_S))

    def enforce_limits(self, now_s: float) -> None:
        """Enforce all limits."""
        for socket in self._sockets:
            for descriptor in socket.accepted():
                self.find(descriptor, socket)
        has_ended = self._forget_ended(now_s)
        self._tarpit.release(now_s)
        connections = []
        for connection in list(self._connections.values()):
            if connection.is_disconnected:  # the peer keeps sending, or blocks libzmq
                kernel_sockets.reset(connection.descriptor, connection.inode)
            else:
                connections.append(connection)
        hold = partial(self._tarpit.add, now_s=now_s)
        for connection, reason in self._quota.excess(connections):
            # An older peer may be idle. If it does not reconnect now, its next messages are lost.
            connection.disconnect(
                reason, end=hold if connection.num_checks < NUM_NEW_CHECKS else None
            )
        for connection in connections:
            connection.update(kernel_sockets.get_traffic(connection.descriptor), now_s)
        _disconnect_heaviest(
            connections, lambda c: c.undelivered, MAX_UNDELIVERED_BYTES, "too much undelivered data"
        )
        max_incomplete = MAX_INCOMPLETE_BYTES + EXTRA_INCOMPLETE_BYTES * len(connections)
        _disconnect_heaviest(
            connections, lambda c: c.incomplete, max_incomplete, "too many incomplete messages"
        )
        _disconnect_heaviest(
            connections, lambda c: c.unread, MAX_UNREAD_MESSAGES, "it reads too little"
        )
        self._has_undelivered = any(c.undelivered > c.incomplete for c in connections)
        if self.waker is not None and (has_ended or self._has_undelivered):
            self.waker.wake()  # the loop handles complete messages and ended connections
        if self._trims_s and now_s >= self._trims_s[0]:
            del self._trims_s[0]
            self._num_ended = 0
            trim_heap()

    def _forget_ended(self, now_s: float) -> bool:
        """Remove ended connections; return whether any connection has ended."""
        ended = [c for c in list(self._connections.values()) if not _exists(c)]
        for connection in ended:
            del self._connections[connection.inode]
            connection.socket.ended.append(connection.inode)
            self._num_ended += 1
            if (
                connection.is_disconnected
                or connection.unread
                or self._num_ended >= NUM_ENDED_BEFORE_TRIM
            ):
                self._trims_s = [now_s + delay_s for delay_s in TRIMS_S]
            self.save_budget(connection)
        for owner in [owner for owner, saved in self._budgets.items() if saved.left >= BUDGET]:
            del self._budgets[owner]
        return bool(ended)


def _exists(connection: PeerConnection) -> bool:
    return kernel_sockets.get_inode(connection.descriptor) == connection.inode


def _disconnect_heaviest(
    connections: Iterable[PeerConnection],
    measure: Callable[[PeerConnection], int],
    limit: int,
    reason: str,
) -> int:
    """Disconnect peers until the sum of a measure is within its limit; return the sum.

    The largest connection of the owner with the largest sum ends first.
    """
    sizes = {c: size for c in connections if not c.is_disconnected and (size := measure(c)) > 0}
    if sum(sizes.values()) <= limit:
        return sum(sizes.values())
    sums: Counter[str] = Counter()
    for connection, size in sizes.items():
        sums[connection.owner] += size
    while sums.total() > limit:
        largest = max(sizes, key=lambda connection: (sums[connection.owner], sizes[connection]))
        largest.disconnect(reason, PENALTY_S)
        sums[largest.owner] -= sizes.pop(largest)
    return sums.total()


def raise_file_limit() -> None:
    """Raise this process's limit of open files as far as the system allows."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    soft = min(hard, MAX_FILES_MACOS) if sys.platform == "darwin" else hard
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
