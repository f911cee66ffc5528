"""Limits the connections of a process, and the work that a peer can cause."""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from kouxing.shared.errors import UserError
from kouxing.shared.settings.keys import MAX_KEY_SHARE

if TYPE_CHECKING:
    from kouxing.shared.network.peer_connection import PeerConnection

MAX_CONNECTIONS = 400  # limit for clients; libzmq takes up to 0.1 MB for each
MIN_CONNECTIONS = 16  # with fewer, even the services of one machine could not connect
FILES_PER_CLIENT = 6  # one for the client, one for a service, and four in the tarpit
RESERVED_FILES = 256  # files for models, pages and outgoing connections
BUDGET = 5000.0  # work of a connection
BUDGET_PER_S = 500.0
MIN_BUDGET = 100.0  # of a new connection: enough for a well-behaved client whose key is misused


class PeerQuota:
    """Limits the connections of clients and of services.

    The limit of clients is ``MAX_CONNECTIONS`` plus ``extra_connections``. The limit of services is
    the same number plus the connections that clients do not use. ``is_service`` returns whether a
    key belongs to a service. Raises ``UserError`` if this process can open too few files.
    """

    def __init__(self, extra_connections: int, is_service: Callable[[str], bool]) -> None:
        max_files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        max_clients = (max_files - RESERVED_FILES) // FILES_PER_CLIENT
        if max_clients < MIN_CONNECTIONS:
            raise UserError(f"the limit of open files is {max_files}; raise it: ulimit -n 1024")
        self.max_clients = min(MAX_CONNECTIONS + extra_connections, max_clients)
        self._is_service = is_service

    def excess(self, connections: Sequence[PeerConnection]) -> Iterator[tuple[PeerConnection, str]]:
        """Yield the connections that must end, with the reason.

        ``connections`` are sorted from the oldest. Silent connections end first. The owner with the
        most connections loses one first: its oldest silent connection, or else its newest
        connection that has sent messages.
        """
        if len(connections) <= MAX_KEY_SHARE * self.max_clients:
            return
        services, known, silent = [], [], []
        for connection in connections:
            if not connection.num_delivered:
                silent.append(connection)
            elif self._is_service(connection.key):
                services.append(connection)
            else:
                known.append(connection)
        silent.reverse()
        ranks: dict[PeerConnection, int] = {}  # among the connections of the same owner, from 1
        counts: Counter[str] = Counter()
        for connection in (*services, *known, *silent):
            counts[connection.owner] += 1
            ranks[connection] = counts[connection.owner]
        clients = known + silent
        max_services = 2 * self.max_clients - min(len(clients), self.max_clients)
        for group, limit in ((clients, self.max_clients), (services, max_services)):
            group.sort(key=lambda connection: (connection.num_delivered == 0, ranks[connection]))
            for connection in reversed(group[limit:]):
                yield connection, "too many connections"
            for connection in group[:limit]:
                if ranks[connection] > MAX_KEY_SHARE * limit:
                    owner = "key" if connection.key else "address"
                    yield connection, f"its {owner} has too many connections"


class PeerBudget:
    """The amount of work that a peer may still cause; recovers over time."""

    def __init__(self, left: float = BUDGET, clock: Callable[[], float] = time.monotonic) -> None:
        self._left, self._clock, self._since_s = left, clock, clock()

    @property
    def left(self) -> float:
        """The remaining budget; negative if the peer overspent."""
        return min(BUDGET, self._left + (self._clock() - self._since_s) * BUDGET_PER_S)

    def spend(self, cost: float) -> None:
        """Reduce the budget."""
        self._left, self._since_s = self.left - cost, self._clock()

    def block(self, seconds: float) -> None:
        """Keep the budget negative for some time."""
        self._left, self._since_s = min(self.left, -seconds * BUDGET_PER_S), self._clock()
