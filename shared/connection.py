"""One connection to a bound socket: what waits of it, what it may spend, and how it is cut."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from kouxing.shared.kernel_sockets import SEES_BYTES, borrowed, bytes_read, bytes_taken, inode_of
from kouxing.shared.logs import LOG, RateLimit

KIB, MIB = 1024, 1024 * 1024
STOPPED_S = 1.0  # without taking anything of what waits for it, and a subscriber stands still
STUCK_S = 0.02  # that bytes wait though all complete messages were delivered
HANDSHAKE = 1 * KIB  # more than a handshake takes on the wire
OVERHEAD = 128  # more than a message's frames, keys and heartbeats take on the wire
CREDIT = 5000.0  # that a connection may spend at once
CREDIT_S = 500.0  # that it gets back in a second
MAX_FAULTS = 100  # of an address, whose new connections are cut then
FAULTS_S = 2  # that an address is forgiven in a second
BAN_S = 3  # until an address with too many faults is let in again, at the longest
BAN_FAULTS = MAX_FAULTS + FAULTS_S * BAN_S  # of one that has sent what no honest one can
_RESET = struct.pack("ii", 1, 0)  # struct linger: on, no time
_SINK = bytearray(MIB)
_DISCARD = socket.MSG_DONTWAIT | socket.MSG_TRUNC
_WARNINGS = RateLimit()


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a bound socket takes; ``cost`` is the credit that each of its messages takes."""

    message_bytes: int  # the largest part
    queue_length: int  # messages of a connection that wait for delivery
    num_slow: int  # connections that may be in the midst of the largest message
    num_answers: int = 20_000  # that wait for one peer; more are lost
    cost: float = 0.0

    @property
    def one_message(self) -> int:
        """Bytes of a connection in the midst of its largest message."""
        return self.message_bytes + 16 * KIB  # and what libzmq reads at once

    @property
    def full_queue(self) -> int:
        """Bytes of a connection whose queue is full of the largest messages."""
        return self.queue_length * (self.message_bytes + OVERHEAD) + self.one_message


class Credit:
    """What a peer may make this process do; it comes back with time."""

    def __init__(self, left: float = CREDIT) -> None:
        self._left = left
        self._since_s = time.monotonic()

    @property
    def left(self) -> float:
        """What may be spent at once."""
        return min(CREDIT, self._left + (time.monotonic() - self._since_s) * CREDIT_S)

    def spend(self, cost: float) -> None:
        """Take some away; less than nothing may be left."""
        self._left, self._since_s = self.left - cost, time.monotonic()


class BoundSocket(Protocol):
    """The socket to which a connection is, as ``kouxing.shared.connections.Guarded``."""

    bounds: Bounds
    turns: int  # times that every connection's next complete message was delivered

    def blame(self, address: str, num_faults: int) -> None:
        """Count faults against an address."""

    def note_end(self, connection: Connection) -> None:
        """Note that a connection has ended."""


class Connection:
    """One connection to a bound socket."""

    def __init__(self, descriptor: int, inode: int) -> None:
        self.descriptor = descriptor
        self.inode = inode  # of the TCP socket: the descriptor's number is used again
        self.guarded: BoundSocket | None = None  # once the guard has seen it
        self.address = ""
        self.key = ""  # of the peer, once something was delivered
        self.owner = ""  # then also: the key, or without keys the address
        self.credit = Credit()
        self.delivered = HANDSHAKE  # bytes; only the socket's thread writes it
        self.answered = 0  # bytes sent to it alone; the same
        self.unread = 0  # bytes that libzmq holds for the peer; the guard's
        self.waiting = 0  # bytes that libzmq holds; the guard's, as all that follows
        self.stuck = 0  # of them, those that waited while all complete messages were delivered
        self.subscribed_bytes = 0
        self._subscriptions: set[bytes] = set()
        self.is_cut = False
        self._num_faults = 0  # that its address was blamed for
        self._surplus = 0  # by which delivered is too high, as overhead is estimated
        self._mark = (0, 0, 0, 0.0)  # delivered, waiting, turns and time at an earlier look
        self._out_mark = (0, 0)  # answered, and given to the kernel, at an earlier look
        self._taken = (-1, 0.0)  # bytes that the peer has acknowledged, and since when no more

    def charge(self, cost: float) -> None:
        """Take credit for what the connection makes this process do; without any it is cut.

        What still waits of one that is cut costs nothing: it is dropped, and those who come next
        from its address shall not pay for it.
        """
        if self.is_cut:
            return
        self.credit.spend(cost)
        if self.credit.left < 0:
            self.cut("it sends too much that is of no use")

    def subscribe(self, topic: bytes) -> None:
        """Note a subscription."""
        if topic not in self._subscriptions:
            self._subscriptions.add(topic)
            self.subscribed_bytes += len(topic)

    def unsubscribe(self, topic: bytes) -> None:
        """Note the end of a subscription."""
        if topic in self._subscriptions:
            self._subscriptions.remove(topic)
            self.subscribed_bytes -= len(topic)

    def wants(self, topics: Iterable[bytes]) -> bool:
        """Return whether it has subscribed to one of some topics."""
        begins = tuple(self._subscriptions)
        return any(topic.startswith(begins) for topic in topics)

    def is_stopped(self, now_s: float) -> bool:
        """Return whether the peer has taken nothing for a while, though something waits for it."""
        before, since_s = self._taken
        taken, waiting = bytes_taken(self.descriptor) if SEES_BYTES else (0, 0)
        if taken == before and waiting:
            return now_s - since_s > STOPPED_S
        self._taken = (taken, now_s)
        return False

    def look_out(self, published: Mapping[bytes, int]) -> None:
        """Find what waits for the peer, from what was sent and what the kernel has taken of it.

        ``published`` has the bytes of each topic since the last look.
        """
        if not self.exists():
            return
        taken, waiting = bytes_taken(self.descriptor) if SEES_BYTES else (0, 0)
        answered, given = self.answered, taken + waiting
        answered_before, given_before = self._out_mark
        self._out_mark = (answered, given)
        if not waiting:  # the kernel has room: nothing waits before it
            self.unread = 0
            return
        begins = tuple(self._subscriptions)
        sent = sum(size for topic, size in published.items() if topic.startswith(begins))
        sent += answered - answered_before
        self.unread = max(0, self.unread + sent - (given - given_before))

    def exists(self) -> bool:
        """Return whether it is not closed yet."""
        return inode_of(self.descriptor) == self.inode

    def look(self, now_s: float) -> None:
        """Find what waits, and what of that is stuck; cut the connection if it is too much.

        A whole turn and a while after bytes came, their message was delivered if it is complete.
        Messages are delivered while this looks, which may take long on a busy machine. So what
        waits is rather taken for too little than for too much: what was delivered is read again.
        """
        if self.guarded is None:
            return
        bounds, turns, before = self.guarded.bounds, self.guarded.turns, self.delivered
        least, most = bytes_read(self.descriptor)
        if not self.exists():  # the figures are those of whoever has its descriptor now
            self.waiting = self.stuck = 0
            return
        delivered = self.delivered
        self._surplus = max(self._surplus, before - max(most, HANDSHAKE))
        self.waiting = max(0, least - delivered + self._surplus)
        marked, waiting, turn, time_s = self._mark
        is_due = turns > turn + 1 and now_s >= time_s + STUCK_S
        if delivered != marked:
            self.stuck = 0
        elif is_due:
            self.stuck = waiting
        if delivered != marked or is_due:
            self._mark = (delivered, self.waiting, self.guarded.turns, time.monotonic())
        if self.waiting > bounds.full_queue:
            self.cut("more waits than a queue holds", BAN_FAULTS)
        elif self.stuck > bounds.one_message:
            self.cut("its message does not end", BAN_FAULTS)

    def cut(self, reason: str, num_faults: int = 1) -> None:
        """End the connection; libzmq then frees what it holds. Any thread may call this.

        Faults count against its address, for each connection those of the worst reason.
        """
        if self.guarded is not None and num_faults > self._num_faults:
            self.guarded.blame(self.address, num_faults - self._num_faults)
            self._num_faults = num_faults
        if self.is_cut:
            return
        self.is_cut = True
        with contextlib.suppress(OSError):  # it may have ended by itself
            own = os.dup(self.descriptor)  # which nobody else closes
            try:
                if inode_of(own) == self.inode:
                    with borrowed(own) as connection:  # reset when libzmq closes it
                        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
                        connection.shutdown(socket.SHUT_RDWR)
                        while connection.recv_into(_SINK, 0, _DISCARD):  # else libzmq reads it
                            pass
            finally:
                os.close(own)
        if _WARNINGS.allows(reason):
            LOG.warning("cut a connection from %s: %s", self.address or "a peer", reason)
