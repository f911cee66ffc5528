"""How much work each worker has, and whether it has room for one more session.

A heartbeat says which share of the last two seconds a worker's loop was busy. Sessions that were
placed or have ended since count at the cost of a session. That is the largest that was measured
lately, and all sessions are expected to take it: who is silent now may speak in a moment.
"""

from __future__ import annotations

from collections import deque

SAME_LOAD = 0.05  # workers whose loads differ by less are taken as equal
NUM_SURE = 2  # sessions that are never refused: where others are busy, too, all seem to cost much
MEASURED_S = 2.0  # over which a worker measures its load
UNMEASURED_COST = 0.25  # of a session at a worker that has served none yet: as on a slow machine
COST_HALF_LIFE_S = 60.0  # of the largest cost that was measured
RETRY_AFTER_S = 5.0  # for a client that is refused


class WorkerLoad:
    """The load of one worker; times in seconds, loads from 0 to 1."""

    def __init__(self) -> None:
        self.num_sessions = 0
        self._num_unpaced = 0
        self._unpaced_until_s = 0.0
        self._measured = 0.0
        self._measured_s = 0.0
        self._idle: float | None = None  # the least load that was measured without sessions
        self._cost: float | None = None
        self._placed_s: deque[float] = deque()  # when sessions were placed, the newest last
        self._left_s: deque[float] = deque()  # when sessions have ended

    @property
    def cost(self) -> float:
        """The load of one session."""
        return UNMEASURED_COST if self._cost is None else self._cost

    def place(self, now_s: float, *, paced: bool) -> None:
        """Note one session more."""
        self.num_sessions += 1
        self._num_unpaced += not paced
        self._placed_s.append(now_s)

    def leave(self, now_s: float, *, paced: bool) -> None:
        """Note one session less."""
        self.num_sessions -= 1
        self._left_s.append(now_s)
        if not paced:
            self._num_unpaced -= 1
            self._unpaced_until_s = now_s + MEASURED_S

    def measure(self, load: float, now_s: float) -> None:
        """Take the load of a heartbeat."""
        if self._is_unpaced(now_s):
            return
        faded = 0.5 ** ((now_s - self._measured_s) / COST_HALF_LIFE_S)
        self._measured, self._measured_s = load, now_s
        num_measured = self.num_sessions + _num_recent(self._left_s, now_s)
        if not num_measured:
            self._idle = load if self._idle is None else min(load, self._idle)
        else:
            cost = max(0.0, load - (self._idle or 0.0)) / num_measured
            self._cost = max(cost, (self._cost or 0.0) * faded)

    def expected(self, now_s: float) -> float:
        """Return the load once all sessions speak."""
        of_sessions = self.num_sessions * self.cost
        if self._is_unpaced(now_s):
            return of_sessions
        num_new = _num_recent(self._placed_s, now_s) - _num_recent(self._left_s, now_s)
        return max(of_sessions, self._measured + num_new * self.cost)

    def has_room(self, now_s: float, max_load: float) -> bool:
        """Return whether one more session is within a limit; the first ones always are."""
        return self.num_sessions < NUM_SURE or self.expected(now_s) + self.cost <= max_load

    def _is_unpaced(self, now_s: float) -> bool:
        """Return whether sound that comes faster than real time takes whatever is free."""
        return self._num_unpaced > 0 or now_s < self._unpaced_until_s


def _num_recent(times_s: deque[float], now_s: float) -> int:
    """Forget what the measured load contains already; return the number of the others."""
    while times_s and times_s[0] <= now_s - MEASURED_S:
        times_s.popleft()
    return len(times_s)
