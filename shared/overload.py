"""Overload policy: how live sessions degrade under load.

First, the block network runs less often for all sessions, so that phones are emitted and corrected
later (:class:`HopController`). Then a session uses the light acoustic model. Finally it skips audio
(:class:`SkipPolicy`).

A session is *behind* if late audio is queued. If it is slightly behind, it uses the light acoustic
model until it has been on time for a while. A session that stays too far behind skips the queued
audio in one cut and continues with the newest audio. An unpaced session gives up nothing and takes
longer instead.

The *lateness* of audio is the time since the audio was due. Audio is due when a sender in real time
would have sent it. Audio that waited in a socket while this process was stopped is therefore late,
although it was just received. Audio that a client sends ahead of the clock is not late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

SLOWDOWN_FRACTION = 0.5  # fraction of the limit above which the block network runs less often
LIGHT_FROM = 0.75  # fraction of the limit above which a session uses the light model
LIGHT_FOR_S = 2.0  # time for which a session that is on time still uses it
MAX_LATE_FOR_S = 0.4  # maximum time for which a session may exceed its limit
REPORT_INTERVAL_S = 1.0  # interval between reports about one session
CATCH_UP_S = 1.5  # time for which a moved session skips nothing
ADAPTATION = 0.1  # fraction of the lateness to ignore if the newest audio is just as late

MAX_HOP = 6  # longest time between runs of the block network, in multiples of the shortest
MAX_LOAD = 0.6  # cores of a recognizer; above it, the network runs less often
RESTORE_LOAD = 0.5  # expected load at which the network runs more often again
RESTORE_AFTER_S = 5.0  # time for which the expected load must be that low
HOP_PERIOD_S = 0.5  # the load is measured over this time


@dataclass(frozen=True, slots=True)
class ProcessorTime:
    """Processor time spent on sessions, in seconds."""

    network_s: float = 0.0  # in the block network
    others_s: float = 0.0  # in the rest of the recognizer

    def __add__(self, other: ProcessorTime) -> ProcessorTime:
        return ProcessorTime(self.network_s + other.network_s, self.others_s + other.others_s)

    def __sub__(self, other: ProcessorTime) -> ProcessorTime:
        return ProcessorTime(self.network_s - other.network_s, self.others_s - other.others_s)


class HopController:
    """Chooses the hop of the block network from the load of a recognizer.

    The network's time is proportional to 1 / hop. The hop is the shortest one whose expected load
    is low enough. It also rises while a session is behind, because other programs use the
    processor. It rises after one period, and falls after several.

    Parameters
    ----------
    work
        The work so far; it does not count toward the load.
    now_s
        The time, in seconds, on any monotonic clock.
    """

    def __init__(self, work: ProcessorTime, now_s: float) -> None:
        self.hop = 1  # in shortest hops
        self._since_s = self._restored_s = now_s
        self._before = work
        self._needed = 1  # the longest hop needed since ``_restored_s``
        self._is_behind = False  # whether a session has been behind since ``_since_s``

    def update(self, work: ProcessorTime, now_s: float, *, is_behind: bool) -> int:
        """Return the hop, given the work on live sessions so far and if a session is behind."""
        self._is_behind |= is_behind
        passed_s = now_s - self._since_s
        if passed_s < HOP_PERIOD_S:
            return self.hop
        newest = work - self._before
        self._since_s, self._before = now_s, work
        network, others = self.hop * newest.network_s / passed_s, newest.others_s / passed_s
        hop = min(self.hop + self._is_behind, MAX_HOP)
        self.hop = max(hop, _shortest_hop(network, others, MAX_LOAD))
        needed = self.hop if self._is_behind else _shortest_hop(network, others, RESTORE_LOAD)
        self._is_behind = False
        self._needed = max(self._needed, needed)
        if needed >= self.hop:
            self._restored_s, self._needed = now_s, 1
        elif now_s - self._restored_s >= RESTORE_AFTER_S:
            self.hop, self._restored_s, self._needed = self._needed, now_s, 1
        return self.hop


def _shortest_hop(network: float, others: float, max_load: float) -> int:
    """Return the shortest hop with at most this load; ``network`` is the network's at hop 1."""
    hops = range(1, MAX_HOP)
    return next((hop for hop in hops if network / hop + others <= max_load), MAX_HOP)


class SkipPolicy:
    """Decides when one live session skips audio. Times are in seconds, on any monotonic clock.

    Parameters
    ----------
    max_lag_s
        Maximum delay of the session. It may be exceeded for ``MAX_LATE_FOR_S``.
    start_s
        Time from which the session may skip audio. A moved session catches up before.
    """

    def __init__(self, max_lag_s: float, start_s: float = -math.inf) -> None:
        self.skipped_s = 0.0  # duration of the audio that was skipped
        self._max_lag_s = max_lag_s
        self._start_s = start_s
        self._due_s: float | None = None  # when the newest audio was due; None: on arrival
        self._late_since_s = math.inf  # when the session exceeded its limit
        self.is_behind = False  # far enough to run the block network less often
        self._light_until_s = -math.inf  # end of the use of the light model
        self._reported_s, self._report_due_s = 0.0, -math.inf  # part of skipped_s; next report

    def add(self, duration_s: float, now_s: float, *, has_waiting: bool) -> None:
        """Record that audio has arrived, and whether other audio is queued before it."""
        due_s = now_s if self._due_s is None else self._due_s + duration_s
        if now_s < self._start_s:
            due_s = now_s
        self._due_s = due_s if has_waiting else min(due_s, now_s)

    def restart(self, start_s: float) -> None:
        """Skip nothing until ``start_s``, because the session has moved."""
        self._start_s = start_s

    def resume(self) -> None:
        """Record that the sender was silent. Its next audio is due on arrival."""
        self._due_s = None

    def is_late(self, now_s: float, *, for_s: float = 0.0) -> bool:
        """Return whether the newest audio exceeds the limit by more than ``for_s``."""
        return self._late_s(0.0, now_s) > self._max_lag_s + for_s

    def adapt(self, now_s: float) -> None:
        """Record that no newer audio was found, so the newest audio may be in time."""
        if self._due_s is not None:
            self._due_s += ADAPTATION * max(0.0, now_s - self._due_s)

    def update(self, waiting_s: float, now_s: float) -> bool:
        """Return whether the session must now skip all audio except the newest.

        ``waiting_s`` is the duration of the audio that is queued after the oldest piece.
        """
        self.is_behind = False
        if now_s < self._start_s:
            return False
        late_s = self._late_s(waiting_s, now_s)
        behind_s = min(waiting_s, late_s)
        self.is_behind = behind_s > SLOWDOWN_FRACTION * self._max_lag_s
        if behind_s > LIGHT_FROM * self._max_lag_s:
            self._light_until_s = now_s + LIGHT_FOR_S
        if behind_s <= self._max_lag_s:
            self._late_since_s = math.inf
        else:  # after a stop of this process, the session has been late for some time
            since_s = now_s - (late_s - self._max_lag_s)
            self._late_since_s = min(since_s, self._late_since_s)
        if now_s - self._late_since_s <= MAX_LATE_FOR_S:
            return False
        self._late_since_s = math.inf
        self.skipped_s += waiting_s
        return True

    def needs_light_model(self, now_s: float) -> bool:
        """Return whether the session is or was recently behind."""
        return now_s < self._light_until_s

    def take_report_s(self, now_s: float) -> float:
        """Return the duration of the audio skipped since the last report, at most once a second."""
        new_s = self.skipped_s - self._reported_s
        if new_s == 0.0 or now_s < self._report_due_s:
            return 0.0
        self._reported_s, self._report_due_s = self.skipped_s, now_s + REPORT_INTERVAL_S
        return new_s

    def _late_s(self, waiting_s: float, now_s: float) -> float:
        return 0.0 if self._due_s is None else now_s - self._due_s + waiting_s
