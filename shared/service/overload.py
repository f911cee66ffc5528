"""Overload policy: how live sessions degrade under load.

First, the block network runs less often for all sessions, so phones are emitted and corrected later
(``services.recognizer.sessions.hop_controller``). Next, a session uses the light acoustic model.
Finally, it skips audio (:class:`SkipPolicy`).

A session is *behind* if late audio is queued. If it is slightly behind, it uses the light acoustic
model until it has been on time for a while. A session that stays too far behind skips all queued
audio and continues with the newest audio. An unpaced session never degrades; it only takes longer.

The *lateness* of audio is the time since the audio was due. Audio is due when a sender in real time
would have sent it. Audio that waited in a socket while this process was stopped is therefore late,
even if it was just received. Audio that a client sends ahead of the clock is not late.
"""

import math

SLOWDOWN_FRACTION = 0.5  # fraction of the limit above which the block network runs less often
LIGHT_MODEL_FRACTION = 0.75  # fraction of the limit above which a session uses the light model
LIGHT_MODEL_HOLD_S = 2.0  # how long a session that is on time again keeps the light model
GRACE_PERIOD_S = 0.4  # time for which a session may exceed its limit
REPORT_INTERVAL_S = 1.0  # interval between reports about one session
CATCH_UP_S = 1.5  # time for which a moved session skips nothing
ADAPTATION = 0.1  # fraction of the lateness that each call of ``adapt`` removes


class SkipPolicy:
    """Decides when one live session skips audio. Times are in seconds, on any monotonic clock.

    ``max_lag_s`` is the maximum delay of the session. It may be exceeded for ``GRACE_PERIOD_S``.
    The session skips nothing before ``start_s``, so that a moved session can catch up.
    """

    def __init__(self, max_lag_s: float, start_s: float = -math.inf) -> None:
        self.skipped_s = 0.0  # duration of the audio that was skipped
        self._max_lag_s = max_lag_s
        self._start_s = start_s  # nothing is skipped before this time
        self._due_s: float | None = None  # when the newest audio was due; None: on arrival
        self._late_since_s = math.inf  # when the session exceeded its limit
        self.is_behind = False  # whether the block network must run less often
        self._light_until_s = -math.inf  # end of the use of the light model
        self._reported_s = 0.0  # the part of ``skipped_s`` that was reported
        self._report_due_s = -math.inf

    def add(self, duration_s: float, now_s: float, *, has_queued: bool) -> None:
        """Record that audio has arrived, and whether other audio is queued before it."""
        due_s = now_s if self._due_s is None else self._due_s + duration_s
        if now_s < self._start_s:
            due_s = now_s
        self._due_s = due_s if has_queued else min(due_s, now_s)

    def postpone(self, start_s: float) -> None:
        """Skip nothing until ``start_s``, because the session has moved."""
        self._start_s = start_s

    def resume(self) -> None:
        """Record that the sender was silent. Its next audio is due on arrival."""
        self._due_s = None

    def is_late(self, now_s: float, *, by_s: float = 0.0) -> bool:
        """Return whether the newest audio exceeds the limit by more than ``by_s``."""
        return self._late_s(0.0, now_s) > self._max_lag_s + by_s

    def adapt(self, now_s: float) -> None:
        """Record that no newer audio was found, so the newest audio may be on time."""
        if self._due_s is not None:
            self._due_s += ADAPTATION * max(0.0, now_s - self._due_s)

    def update(self, waiting_s: float, now_s: float) -> bool:
        """Return whether the session must now skip all audio except the newest.

        ``waiting_s`` is the duration of the audio that is queued after the oldest chunk.
        """
        self.is_behind = False
        if now_s < self._start_s:
            return False
        late_s = self._late_s(waiting_s, now_s)
        behind_s = min(waiting_s, late_s)
        self.is_behind = behind_s > SLOWDOWN_FRACTION * self._max_lag_s
        if behind_s > LIGHT_MODEL_FRACTION * self._max_lag_s:
            self._light_until_s = now_s + LIGHT_MODEL_HOLD_S
        if behind_s <= self._max_lag_s:
            self._late_since_s = math.inf
        else:  # after a stop of this process, the session has been late for some time
            since_s = now_s - (late_s - self._max_lag_s)
            self._late_since_s = min(since_s, self._late_since_s)
        if now_s - self._late_since_s <= GRACE_PERIOD_S:
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
