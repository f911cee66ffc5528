"""How much work a peer may cause."""

from __future__ import annotations

import time
from collections.abc import Callable

BUDGET = 5000.0  # of a connection
BUDGET_PER_S = 500.0
MIN_BUDGET = 100.0  # of a new connection: enough for an honest client of a key that was misused


class Budget:
    """How much work a peer may still cause; it recovers with time."""

    def __init__(self, left: float = BUDGET, clock: Callable[[], float] = time.monotonic) -> None:
        self._left, self._clock, self._since_s = left, clock, clock()

    @property
    def left(self) -> float:
        """What may be spent now; negative after too much was spent."""
        return min(BUDGET, self._left + (self._clock() - self._since_s) * BUDGET_PER_S)

    def spend(self, cost: float) -> None:
        """Reduce the budget."""
        self._left, self._since_s = self.left - cost, self._clock()

    def block(self, seconds: float) -> None:
        """Keep the budget negative for some time."""
        self._left, self._since_s = min(self.left, -seconds * BUDGET_PER_S), self._clock()
