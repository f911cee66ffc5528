"""One connection to a bound socket: its traffic, its subscriptions, and its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from kouxing.shared.monitoring.logs import LOG, RateLimit
from kouxing.shared.network import kernel_sockets
from kouxing.shared.network.kernel_sockets import Traffic
from kouxing.shared.network.peer_quota import PeerBudget
from kouxing.shared.network.socket_limits import MAX_QUEUED

if TYPE_CHECKING:
    from kouxing.shared.network.connection_limits import LimitedSocket

STALLED_S = 1.0  # a live subscriber that reads nothing for this time is disconnected
PENALTY_S = 1.0  # a disconnected peer cannot connect again for this time
LONG_PENALTY_S = 3.0  # after behavior that only hostile peers show
_WARNINGS = RateLimit()


class PeerConnection:
    """One connection to a bound socket."""

    def __init__(self, descriptor: int, inode: int, socket: LimitedSocket) -> None:
        self.descriptor = descriptor
        self.inode = inode  # identifies the connection; the kernel reuses descriptors
        self.socket = socket
        self.address = kernel_sockets.get_peer_address(descriptor)
        self.key = ""  # the peer's key; known when its first message is delivered
        self.budget = PeerBudget()
        self.num_delivered = 0  # messages
        self.num_checks = 0
        self.topics: set[bytes] = set()
        self.is_disconnected = False
        self.undelivered = 0  # bytes since the last delivered message
        self.incomplete = 0  # minimum number of these bytes that belong to an incomplete message
        self.unread = 0  # maximum number of messages that may wait for the peer
        self._delivered_before = 0
        self._read_before = 0  # bytes, when num_delivered last changed
        self._mark = (0, 0)  # undelivered bytes and number of polls at an earlier check
        self._sent_before = socket.num_sent  # when nothing waited for the peer
        self._acknowledged = 0
        self._stalled_since_s = 0.0
        self._had_unsent = False

    @property
    def owner(self) -> str:
        """Owner of the connection: the peer's key or, without keys, its address."""
        return self.key or self.address

    @property
    def topic_bytes(self) -> int:
        """Size of all subscriptions."""
        return sum(map(len, self.topics))

    def spend(self, cost: float) -> None:
        """Charge the peer for work; disconnect it when its budget is used up."""
        if not self.is_disconnected:
            self.budget.spend(cost)
            if self.budget.left < 0:
                self.disconnect("it sends too many useless messages", PENALTY_S)

    def update(self, traffic: Traffic, now_s: float) -> None:
        """Update the figures; disconnect a peer that sends an endless message."""
        self.num_checks += 1
        if self.num_delivered != self._delivered_before:
            self._delivered_before, self._read_before = self.num_delivered, traffic.read
            self._mark = (0, self.socket.num_polls)
            self.incomplete = 0
        self.undelivered = traffic.read - self._read_before
        if self.socket.num_polls > self._mark[1] + 1:  # a complete message would be delivered
            self.incomplete = self._mark[0]
            self._mark = (self.undelivered, self.socket.num_polls)
        if not traffic.unsent:
            self._sent_before = self.socket.num_sent
        self.unread = min(MAX_QUEUED, self.socket.num_sent - self._sent_before)
        is_waiting = traffic.unsent > 0 and traffic.acknowledged == self._acknowledged
        if not (is_waiting and self._had_unsent):
            self._stalled_since_s = now_s
        self._acknowledged, self._had_unsent = traffic.acknowledged, traffic.unsent > 0
        limits = self.socket.limits
        if self.incomplete > limits.message_bytes or self.undelivered > limits.undelivered_bytes:
            self.disconnect("it sent an endless message", LONG_PENALTY_S)

    def is_stalled(self, now_s: float) -> bool:
        """Return whether the peer has read nothing for a while, although data is queued for it."""
        return self.unread > 0 and now_s - self._stalled_since_s > STALLED_S

    def disconnect(
        self, reason: str, penalty_s: float = 0.0, end: Callable[[int, int], None] | None = None
    ) -> None:
        """End the connection, and log the reason. Any thread may call this.

        The peer's key or address cannot connect again for ``penalty_s``. ``end`` is by default
        ``kernel_sockets.reset``.
        """
        if self.is_disconnected:
            return
        self.is_disconnected = True
        if penalty_s:
            self.budget.block(penalty_s)
            self.socket.limiter.save_budget(self)
        (end or kernel_sockets.reset)(self.descriptor, self.inode)
        if _WARNINGS.allows(reason):
            LOG.warning("disconnected a peer at %s: %s", self.address or "?", reason)
