"""The bounds of a process's connections, kept before ZeroMQ delivers anything.

libzmq bounds the size of a part and the number of messages in a queue. It bounds neither the parts
of a message, which it holds until the last one is there, nor subscriptions, nor connections. A
thread here sees how many bytes each connection has brought (Linux's ``TCP_INFO``) and how many of
them were delivered. What waits in between is bounded, or the connection is cut, which frees all it
held. An honest peer is never cut: its queue fills, ZeroMQ stops reading, and it waits.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator

import zmq

from kouxing.shared.connection import (
    BAN_FAULTS,
    CREDIT,
    FAULTS_S,
    HANDSHAKE,
    KIB,
    MAX_FAULTS,
    MIB,
    OVERHEAD,
    STUCK_S,
    Bounds,
    Connection,
    Credit,
)
from kouxing.shared.kernel_sockets import SEES_BYTES, address_of, inode_of, network_of, port_of
from kouxing.shared.metrics import give_back_memory

RECEIVE_BUFFER = 256 * KIB  # of the kernel; a few segments of loopback, or it stalls
LOOK_S = 0.02  # between looks while bytes arrive
NEAR_LOOK_S = 0.005  # while much waits, and at first: a flood takes some 5 MB in that time
NEAR_S = 0.2  # after a connection has come
MUCH = 128 * KIB  # more than honest peers' messages take as a rule
SWEEP_S = 1.0  # between looks at all connections: some have ended, or ZeroMQ was too quick to see
STUCK_SMALL = 4 * KIB  # of each connection, that a busy ZeroMQ may not have passed on yet
MAX_WAITING = 24 * MIB  # of all connections
MAX_UNREAD = 16 * MIB  # of all connections; in memory twice that where messages are small
MAX_CONNECTIONS = 1024  # each takes up to 50 KiB
MAX_SHARE = 0.75  # of them that may come from one address, or have one key
RESERVED_FILES = 256  # for the process itself: models, pages, its own connections
MAX_SUBSCRIPTION = 128  # bytes of a topic's beginning
MAX_SUBSCRIBED = 32 * KIB  # of a connection: 64 sessions; in memory up to 60 times that, or 120
MAX_ALL_SUBSCRIBED = 192 * KIB  # of all connections
SUBSCRIBED_FAULTS = 10  # of a connection that has subscribed to too much
NUM_TRIMS = 3  # in the seconds after a cut, for libzmq frees what it held a little later
_EVENT = struct.Struct("=HI")  # of a monitor: its kind and a value, here the descriptor
_ONCE = select.EPOLLIN | select.EPOLLONESHOT if SEES_BYTES else 0


class Guarded:
    """The connections of one bound socket; its thread says what was delivered."""

    def __init__(self, guard: Guard, bounds: Bounds, monitor: zmq.Socket[bytes]) -> None:
        self.bounds = bounds
        self.port = 0  # where it is bound; 0: nowhere yet
        self.turns = 0  # times that every connection's next complete message was delivered
        self._guard = guard
        self._monitor = monitor
        self.num_sent = 0  # bytes, each message once, since the guard looked
        self._published: Counter[bytes] = Counter()  # of them by topic
        self._num_delivered = 0  # in this turn
        self._ended: deque[int] = deque(maxlen=MAX_CONNECTIONS)  # numbers; the thread adds

    def delivered(self, descriptor: int, num_bytes: int, key: str) -> Connection | None:
        """Note a message that came through a descriptor; return its connection if it lasts.

        ``key`` is that of its sender, empty without keys.
        """
        connection = self._guard.connection(descriptor, self.port)
        if connection is None:
            return None
        if connection.guarded is None:  # the guard has not come to it yet
            connection.guarded, connection.address = self, address_of(descriptor)
        if not connection.owner:
            connection.key, connection.owner = key, key or connection.address
            self._guard.bound_owner(connection)
        connection.delivered += num_bytes + OVERHEAD
        self._num_delivered += 1
        if self._num_delivered > self._guard.num_connections:  # ZeroMQ takes them one by one
            self.drained()
        connection.charge(self.bounds.cost)
        return connection

    def blame(self, address: str, num_faults: int) -> None:
        """Count faults against an address."""
        faults = self._guard.faults
        faults[address] = min(faults[address] + num_faults, BAN_FAULTS)

    def drained(self) -> None:
        """Note that every complete message was delivered."""
        self.turns += 1
        self._num_delivered = 0

    def subscribed(self, connection: Connection, message: bytes) -> None:
        """Note that a connection begins (1) or ends (0) a subscription to a topic's beginning."""
        begins, topic = message[:1] == b"\x01", message[1:]
        if len(topic) > MAX_SUBSCRIPTION:
            connection.cut("a subscription is too long")
        elif begins:
            connection.subscribe(topic)
            self._guard.bound_subscriptions(connection, len(topic))
        else:
            connection.unsubscribe(topic)

    def published(self, topic: bytes, num_bytes: int) -> None:
        """Note a message to all that have subscribed to its topic."""
        self.num_sent += num_bytes
        self._published[topic] += num_bytes

    def answered(self, number: int, num_bytes: int) -> None:
        """Note a message to one connection."""
        self.num_sent += num_bytes
        self._guard.note_answer(number, num_bytes)

    def look_out(self) -> None:
        """Find what waits for each peer."""
        counted, self._published, self.num_sent = self._published, Counter(), 0
        published = dict(counted)  # the socket's thread may add to the other yet
        for connection in self._guard.connections_to(self):
            connection.look_out(published)

    def note_end(self, connection: Connection) -> None:
        """Note that a connection has ended."""
        self._ended.append(connection.inode)

    def is_open(self, number: int) -> bool:
        """Return whether the connection of a number has not ended."""
        return self._guard.is_open(number)

    def ended(self) -> Iterator[int]:
        """Yield the numbers of the connections that have ended since the last call."""
        while self._ended:
            yield self._ended.popleft()

    def cut_stopped(self, topics: Collection[bytes], now_s: float) -> None:
        """Cut subscribers to some topics that stand still; what waits for them is dropped."""
        for connection in self._guard.connections_to(self):
            if connection.wants(topics) and connection.is_stopped(now_s):
                connection.cut("it takes nothing, and what waits for it grows old", 0)

    @property
    def descriptor(self) -> int:
        """Readable when connections may have come or ended (edge-triggered)."""
        return int(self._monitor.getsockopt(zmq.FD))

    def events(self) -> Iterator[tuple[int, int]]:
        """Yield what happened, ``zmq.EVENT_ACCEPTED`` or another end of a connection, and where."""
        with contextlib.suppress(zmq.Again):
            while True:
                event, _endpoint = self._monitor.recv_multipart(zmq.DONTWAIT)
                yield _EVENT.unpack(event)

    def close(self) -> None:
        """Stop watching."""
        self._monitor.close(linger=0)


class Guard:
    """Watches the connections of all bound sockets of a process.

    Parameters
    ----------
    extra_connections
        How many more it may have than others.
    """

    def __init__(self, extra_connections: int = 0) -> None:
        self._extra_connections = extra_connections
        self.faults: Counter[str] = Counter()  # by address; both threads add
        self._connections: dict[int, Connection] = {}  # by inode; both threads add
        self._credits: dict[str, Credit] = {}  # of owners whose connections ended; the thread's
        self._descriptors: dict[int, Connection] = {}  # the thread's, as all that follows
        self._pending: set[Connection] = set()  # something of theirs waits
        self._ending: set[Connection] = set()  # ZeroMQ is about to close them
        self._guarded: list[Guarded] = []
        self._admitted_s = self._swept_s = 0.0
        self._num_trims = 0  # still to come
        self._subscribed = 0  # bytes, since they were counted; the sockets' thread's
        self._max_connections = 0
        self._is_stopping = False
        self._thread = threading.Thread(target=self._run, name="guard", daemon=True)
        self._events = select.epoll() if SEES_BYTES else None
        self._wake = os.eventfd(0) if SEES_BYTES else -1

    @property
    def num_connections(self) -> int:
        """How many connections there are, or were a moment ago."""
        return len(self._connections)

    def watch(self, raw: zmq.Socket[bytes], bounds: Bounds) -> Guarded:
        """Set the bounds of a socket that is not bound yet, and watch its connections."""
        raw.setsockopt(zmq.MAXMSGSIZE, bounds.message_bytes)
        raw.setsockopt(zmq.RCVHWM, bounds.queue_length)
        raw.setsockopt(zmq.RCVBUF, RECEIVE_BUFFER)
        monitor = raw.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        guarded = Guarded(self, bounds, monitor)
        self._guarded.append(guarded)
        if self._events is not None:
            self._events.register(guarded.descriptor, select.EPOLLIN | select.EPOLLET)
        if not self._thread.is_alive():
            if self._events is not None:
                self._events.register(self._wake, select.EPOLLIN | select.EPOLLET)
            max_files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            wanted = MAX_CONNECTIONS + self._extra_connections
            self._max_connections = max(1, min(wanted, max_files - RESERVED_FILES))
            self._thread.start()
        if self._events is not None:
            os.eventfd_write(self._wake, 1)  # a monitor tells of nothing until it was once read
        return guarded

    def connection(self, descriptor: int, port: int) -> Connection | None:
        """Return the connection of a descriptor to a port, None if it is closed.

        Then another socket of the process may have the descriptor, which is not watched.
        """
        inode = inode_of(descriptor)
        known = None if inode is None else self._connections.get(inode)
        if known is not None or inode is None or port != port_of(descriptor):
            return known
        return self._connections.setdefault(inode, Connection(descriptor, inode))

    def is_open(self, inode: int) -> bool:
        """Return whether a connection has not ended."""
        known = self._connections.get(inode)
        return known is not None and known.exists()

    def connections_to(self, guarded: Guarded) -> list[Connection]:
        """Return the connections to a socket."""
        connections = list(self._connections.values())
        return [each for each in connections if each.guarded is guarded and not each.is_cut]

    def note_answer(self, number: int, num_bytes: int) -> None:
        """Note a message to one connection, if it lasts."""
        if (connection := self._connections.get(number)) is not None:
            connection.answered += num_bytes

    def cut_keys(self, keys: Collection[str]) -> None:
        """Cut the connections of some keys; those that delivered nothing get nothing, either."""
        for connection in list(self._connections.values()):
            if connection.key in keys:
                connection.cut("its key is allowed no longer, or not for the same", 0)

    def is_shut_out(self, address: str) -> bool:
        """Return whether nobody may connect from an address for now."""
        return self.faults[network_of(address)] > MAX_FAULTS

    def bound_owner(self, connection: Connection) -> None:
        """Let a connection begin with the credit that its owner has left from those before.

        One whose key has too many is cut.
        """
        if (kept := self._credits.get(connection.owner)) is not None:
            connection.credit = Credit(kept.left)
        shared = [each for each in list(self._connections.values()) if each.key == connection.key]
        num_shared = sum(not each.is_cut for each in shared)
        if connection.key and num_shared > MAX_SHARE * self._max_connections:
            connection.cut("its key has too many connections", 0)

    def bound_subscriptions(self, connection: Connection, num_bytes: int) -> None:
        """Keep the subscriptions of one connection, and of all, within their bounds."""
        if connection.subscribed_bytes > MAX_SUBSCRIBED:
            connection.cut("it has too many subscriptions", SUBSCRIBED_FAULTS)
        self._subscribed += num_bytes
        if self._subscribed > MAX_ALL_SUBSCRIBED:
            self._subscribed = _shed(
                list(self._connections.values()),
                "subscribed_bytes",
                MAX_ALL_SUBSCRIBED,
                "there are too many subscriptions",
            )

    def close(self) -> None:
        """Stop watching."""
        self._is_stopping = True
        if self._thread.is_alive():
            if self._events is not None:
                os.eventfd_write(self._wake, 1)
            self._thread.join()
        for guarded in self._guarded:
            guarded.close()
        if self._events is not None:
            self._events.close()
            os.close(self._wake)

    def _run(self) -> None:
        while not self._is_stopping:
            ready = self._wait()
            now_s = time.monotonic()
            self._take_events()
            is_due = now_s > self._swept_s + SWEEP_S
            if is_due:
                self._swept_s = now_s
                self._sweep()
                self._forgive()
            self._look(ready, now_s)
            num_sent = sum(guarded.num_sent for guarded in self._guarded)
            if is_due or num_sent * self.num_connections > MAX_UNREAD / 4:
                self._look_out()
            much = any(connection.waiting > MUCH for connection in self._pending)
            is_near = much or self.faults or now_s < self._admitted_s + NEAR_S
            time.sleep(NEAR_LOOK_S if is_near else LOOK_S)

    def _wait(self) -> list[Connection]:
        """Wait until bytes arrive or something is due; return the connections that have some."""
        timeout_s = STUCK_S if self._pending or self._ending else SWEEP_S
        if self._events is None:
            time.sleep(STUCK_S)
            return []
        descriptors = [descriptor for descriptor, _ in self._events.poll(timeout_s)]
        return [self._descriptors[each] for each in descriptors if each in self._descriptors]

    def _take_events(self) -> None:
        """Begin to watch new connections, and say of others that they have ended."""
        accepted: list[tuple[int, Guarded]] = []
        for guarded in self._guarded:
            for event, descriptor in guarded.events():
                if event == zmq.EVENT_ACCEPTED:
                    accepted.append((descriptor, guarded))
                elif descriptor in self._descriptors:  # if it is used again, it is not closed
                    self._ending.add(self._descriptors[descriptor])
        self._admit(accepted)
        self._forget_ended(self._ending)

    def _admit(self, accepted: Iterable[tuple[int, Guarded]]) -> None:
        """Begin to watch connections; cut the newest where there are too many."""
        admitted = []
        for descriptor, guarded in accepted:
            connection = self.connection(descriptor, guarded.port)
            if connection is None:
                continue
            connection.address = address_of(descriptor)
            connection.guarded = guarded
            self._descriptors[descriptor] = connection
            is_silent = connection.delivered == HANDSHAKE  # else it came before
            if is_silent and self.faults[connection.address] > MAX_FAULTS:
                connection.cut("its address sent too much that is of no use", 0)
            self._pending.add(connection)  # bytes may have come before
            admitted.append(connection)
            self._admitted_s = time.monotonic()
            if self._events is not None:
                with contextlib.suppress(OSError):  # it has just ended
                    self._events.register(descriptor, _ONCE)
        if admitted and self.num_connections > MAX_SHARE * self._max_connections:
            self._bound_number(admitted)

    def _bound_number(self, admitted: list[Connection]) -> None:
        """Keep the number of connections, of each address and of all.

        Those that never said anything go first, the oldest of them before newer ones.
        """
        self._sweep()
        uncut = [each for each in list(self._connections.values()) if not each.is_cut]
        silent = [connection for connection in uncut if connection.delivered == HANDSHAKE]
        shares = Counter(connection.address for connection in uncut)
        for connection in (*silent, *reversed(admitted)):
            if connection.is_cut:
                continue
            if shares.total() > self._max_connections:
                connection.cut("there are too many connections", 0)
            elif shares[connection.address] > MAX_SHARE * self._max_connections:
                connection.cut("its address has too many connections", 0)
            shares[connection.address] -= connection.is_cut

    def _sweep(self) -> None:
        """Forget the connections that have ended; return the memory of those that were cut.

        The others are looked at: bytes that ZeroMQ took while the thread slept woke nobody.
        """
        self._forget_ended(list(self._connections.values()))
        self._pending.update(self._descriptors.values())
        if self._num_trims:
            self._num_trims -= 1
            give_back_memory()

    def _forget_ended(self, connections: Iterable[Connection]) -> None:
        """Forget those of some connections that have ended, and say so."""
        for connection in [each for each in connections if not each.exists()]:
            if connection.is_cut or connection.unread:
                self._num_trims = NUM_TRIMS
            self._ending.discard(connection)
            self._pending.discard(connection)
            if self._descriptors.get(connection.descriptor) is connection:
                del self._descriptors[connection.descriptor]
            if self._connections.pop(connection.inode, None) and connection.guarded is not None:
                connection.guarded.note_end(connection)
                self._keep_credit(connection)

    def _look_out(self) -> None:
        """Keep the bound of what waits for peers that do not take it."""
        for guarded in self._guarded:
            guarded.look_out()
        _shed(list(self._connections.values()), "unread", MAX_UNREAD, "it takes too little")

    def _keep_credit(self, connection: Connection) -> None:
        """Keep what is left of a connection's credit for the next ones of its owner."""
        kept = self._credits.get(connection.owner)
        if connection.credit.left < (CREDIT if kept is None else kept.left):
            self._credits[connection.owner] = connection.credit

    def _forgive(self) -> None:
        """Take a second's faults off every address, and forget whose credit is whole again."""
        for owner in [each for each, credit in self._credits.items() if credit.left == CREDIT]:
            del self._credits[owner]
        for address in list(self.faults):
            self.faults[address] -= FAULTS_S
            if self.faults[address] <= 0:
                del self.faults[address]

    def _look(self, ready: Iterable[Connection], now_s: float) -> None:
        """Keep the bounds of what waits, of each connection and of all."""
        if self._events is None:
            return
        self._pending.update(ready)
        for connection in list(self._pending):
            if not connection.is_cut:
                connection.look(now_s)
            if connection.is_cut or not connection.waiting:
                self._pending.discard(connection)
        for connection in ready:
            with contextlib.suppress(OSError):  # it has just ended
                self._events.modify(connection.descriptor, _ONCE)
        for guarded in self._guarded:
            max_stuck = guarded.bounds.num_slow * guarded.bounds.message_bytes
            max_stuck += STUCK_SMALL * self.num_connections
            own = [each for each in self._pending if each.guarded is guarded]
            _shed(own, "stuck", max_stuck, "too many messages do not end")
        _shed(self._pending, "waiting", MAX_WAITING, "too much waits")


def _shed(connections: Iterable[Connection], measure: str, limit: int, reason: str) -> int:
    """Cut connections until all together keep the limit of something; return what is left.

    The largest of whoever has the most in sum go first.
    """
    shares: dict[Connection, int] = {
        connection: share
        for connection in connections
        if not connection.is_cut and (share := getattr(connection, measure)) > 0
    }
    if sum(shares.values()) <= limit:
        return sum(shares.values())
    sums: Counter[str] = Counter()
    for connection, share in shares.items():
        sums[connection.owner] += share
    while sums.total() > limit:
        largest = max(shares, key=lambda each: (sums[each.owner], shares[each]))
        largest.cut(reason)
        sums[largest.owner] -= shares.pop(largest)
    return sums.total()


def raise_file_limit() -> None:
    """Let this process open as many files as it may."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # macOS takes no more than it has
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
