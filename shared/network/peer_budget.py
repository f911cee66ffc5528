"""Limits the work that a peer can cause."""

import time
from collections.abc import Callable

BUDGET = 5000.0  # per connection
BUDGET_PER_S = 500.0
MIN_BUDGET = 100.0  # budget of a new connection: enough for a good client whose key is misused


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
