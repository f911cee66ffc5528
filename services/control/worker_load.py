"""Measures the load of each worker, and decides whether it has room for another session.

A heartbeat states the fraction of the last two seconds in which a worker's loop was busy. Sessions
that were placed or ended since then count with the cost of one session: the highest cost measured
recently. Every session is expected to cost this much, because a silent client may start to speak
at any moment. A worker processes the audio of all sessions together, so each of many sessions
costs less. While most sessions speak, the cost falls quickly to the load divided by their number.
While they are silent, it does not fall below this value.
"""

from collections import deque

from kouxing.shared.monitoring.metrics import LOAD_PERIOD_S

EQUAL_LOAD = 0.05  # loads that differ by less are equal
MIN_SESSIONS = 2  # always accepted, because every session seems expensive on a busy machine
DEFAULT_COST = 0.1  # cost of a session until it is measured; typical of a slow machine
COST_HALF_LIFE_S = 60.0  # half-life of the highest measured cost
SPEAKING_HALF_LIFE_S = 4.0  # half-life of the cost while speaking sessions cost less
RETRY_AFTER_S = 5.0  # wait of a rejected client


class WorkerLoad:
    """The load of one worker, from 0 to 1; times in seconds."""

    def __init__(self) -> None:
        self.num_sessions = 0
        self._num_unpaced = 0
        self._unpaced_until_s = 0.0
        self._measured_load = 0.0
        self._measured_at_s = 0.0
        self._idle_load: float | None = None  # lowest load without sessions
        self._cost: float | None = None
        self._speaking_cost = 0.0  # cost of a session, when most sessions last spoke
        self._placed_s: deque[float] = deque()  # times of recent placements
        self._ended_s: deque[float] = deque()  # times of recent ends

    @property
    def cost(self) -> float:
        """The load of one session."""
        return DEFAULT_COST if self._cost is None else self._cost

    def add_session(self, now_s: float, *, paced: bool) -> None:
        """Count an additional session."""
        self.num_sessions += 1
        self._num_unpaced += not paced
        self._placed_s.append(now_s)

    def remove_session(self, now_s: float, *, paced: bool) -> None:
        """Stop counting a session."""
        self.num_sessions -= 1
        self._ended_s.append(now_s)
        if not paced:
            self._num_unpaced -= 1
            self._unpaced_until_s = now_s + LOAD_PERIOD_S

    def measure(self, load: float, now_s: float, num_speaking: int = 0) -> None:
        """Update the cost from the load in a heartbeat. The load includes silent sessions."""
        if self._is_unpaced(now_s):
            return
        passed_s = now_s - self._measured_at_s
        self._measured_load, self._measured_at_s = load, now_s
        num_measured = self.num_sessions + _num_recent(self._ended_s, now_s)
        if not num_measured:
            self._idle_load = load if self._idle_load is None else min(load, self._idle_load)
        else:
            sessions_load = max(0.0, load - (self._idle_load or 0.0))
            mean = sessions_load / num_measured
            if 2 * num_speaking >= num_measured:
                self._speaking_cost = mean
            is_cheaper = self.cost * num_speaking > sessions_load
            half_life_s = SPEAKING_HALF_LIFE_S if is_cheaper else COST_HALF_LIFE_S
            decayed = (self._cost or 0.0) * 0.5 ** (passed_s / half_life_s)
            self._cost = max(mean, decayed, self._speaking_cost)

    def expected(self, now_s: float) -> float:
        """Return the expected load when all sessions speak."""
        sessions_load = self.num_sessions * self.cost
        if self._is_unpaced(now_s):
            return sessions_load
        num_new = _num_recent(self._placed_s, now_s) - _num_recent(self._ended_s, now_s)
        return max(sessions_load, self._measured_load + num_new * self.cost)

    def has_room(self, num_new: int, now_s: float, max_load: float) -> bool:
        """Return whether more sessions stay within a limit; the first sessions always do."""
        if self.num_sessions + num_new <= MIN_SESSIONS or not num_new:
            return True
        return self.expected(now_s) + num_new * self.cost <= max_load

    def _is_unpaced(self, now_s: float) -> bool:
        """Return whether the load is meaningless, because unpaced audio uses all idle time."""
        return self._num_unpaced > 0 or now_s < self._unpaced_until_s


def _num_recent(times_s: deque[float], now_s: float) -> int:
    """Drop the times that the measured load already includes; return the number of later times."""
    while times_s and times_s[0] <= now_s - LOAD_PERIOD_S:
        times_s.popleft()
    return len(times_s)
