"""The overload policy: on a busy machine, a live session skips old audio to stay live.

A session is *behind* if late audio waits to be processed. If it stays too far behind, it skips the
waiting audio in one cut and continues with the newest audio. An unpaced session skips nothing: it
takes longer instead.

Audio is *late* by the time since it was due. Each piece of audio is due when the sender would have
sent it in real time. So audio that waited in a socket while this process was stopped is late,
although it was just received. Audio that a client sends ahead of the clock is not late.
"""

from __future__ import annotations

import math

MAX_LATE_FOR_S = 0.4  # a session may be further behind than its limit for this time
REPORT_INTERVAL_S = 1.0  # between reports about one session
CATCH_UP_S = 1.5  # for a session that moved
ADAPTED = 0.1  # part of the lateness that is forgotten if the newest audio is just as late


class Overload:
    """The overload policy of one live session. Times are in seconds, on any monotonic clock.

    Parameters
    ----------
    max_behind_s
        Limit for how far the session is behind. It may exceed this for ``MAX_LATE_FOR_S``.
    start_s
        The policy starts at this time. A moved session catches up before.
    """

    def __init__(self, max_behind_s: float, start_s: float = -math.inf) -> None:
        self.skipped_s = 0.0  # duration of the audio that was skipped
        self._max_behind_s = max_behind_s
        self._start_s = start_s
        self._due_s: float | None = None  # when the newest audio was due; None: when it arrives
        self._late_since_s = math.inf  # when it exceeded its limit
        self._reported_s, self._report_due_s = 0.0, -math.inf  # part of skipped_s; next report

    def add(self, duration_s: float, now_s: float, *, has_waiting: bool) -> None:
        """Record that audio has arrived, and whether other audio waits before it."""
        due_s = now_s if self._due_s is None else self._due_s + duration_s
        if now_s < self._start_s:
            due_s = now_s
        self._due_s = due_s if has_waiting else min(due_s, now_s)

    def restart(self, start_s: float) -> None:
        """Start again at a time; the session has moved."""
        self._start_s = start_s

    def resume(self) -> None:
        """Record that the sender was silent: its next audio is due when it arrives."""
        self._due_s = None

    def is_late(self, now_s: float, *, for_s: float = 0.0) -> bool:
        """Return whether the newest audio has been late by more than the limit, for some time."""
        return self._late_s(0.0, now_s) > self._max_behind_s + for_s

    def adapt(self, now_s: float) -> None:
        """Record that the newest audio was just received: it may be in time."""
        if self._due_s is not None:
            self._due_s += ADAPTED * max(0.0, now_s - self._due_s)

    def update(self, waiting_s: float, now_s: float) -> bool:
        """Return whether the session must now skip all audio but the newest.

        ``waiting_s`` is the duration of the audio after the oldest piece that is not processed.
        """
        if now_s < self._start_s:
            return False
        late_s = self._late_s(waiting_s, now_s)
        behind_s = min(waiting_s, late_s)
        if behind_s <= self._max_behind_s:
            self._late_since_s = math.inf
        else:  # if this process was stopped, the session was late before
            since_s = now_s - (late_s - self._max_behind_s)
            self._late_since_s = min(since_s, self._late_since_s)
        if now_s - self._late_since_s <= MAX_LATE_FOR_S:
            return False
        self._late_since_s = math.inf
        self.skipped_s += waiting_s
        return True

    def take_report_s(self, now_s: float) -> float:
        """Return the duration of the audio skipped since the last report, at most once a second."""
        new_s = self.skipped_s - self._reported_s
        if new_s == 0.0 or now_s < self._report_due_s:
            return 0.0
        self._reported_s, self._report_due_s = self.skipped_s, now_s + REPORT_INTERVAL_S
        return new_s

    def _late_s(self, waiting_s: float, now_s: float) -> float:
        return 0.0 if self._due_s is None else now_s - self._due_s + waiting_s
