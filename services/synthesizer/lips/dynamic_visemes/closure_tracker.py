"""Postpones closures (b p m, f) that are recognized after their apex.

A closure that is less than ``_MAX_LATE_S`` late is moved to a time at which it can be shown.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import VisemeParameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline
from kouxing.shared.arrays import Doubles, Mask
from kouxing.shared.fast_record import replace

_MAX_LATE_S = 0.1  # closures recognized later than this after their apex are not shown
_CATCH_UP_S = 0.04  # time from the last frame to a postponed apex
_MIN_TRANSITION_S = 0.02  # shortest transition to a closure
_CLOSED_DISTANCE = 10.0  # a lip counts as closed within this distance of its target, FAP units


class ClosureTracker:
    """Tracks which closures have been shown and which are postponed."""

    def __init__(self, parameters: VisemeParameters, frame_rate_hz: float) -> None:
        self._target = parameters.target
        self._frame_s = 1.0 / frame_rate_hz
        self._closes: Mask = parameters.closes > 0.0  # (num_visemes, num_mouth_faps)
        self._any_closes = parameters.any_closes
        self._shown: set[int] = set()  # phone indices
        self._postponed_s: dict[int, float] = {}  # apex by phone index

    def postpone(self, timeline: Timeline, last_s: float, time_s: float) -> tuple[Timeline, bool]:
        """Move closures whose apex passed before they were recognized.

        ``last_s`` and ``time_s`` are the times of the last and the next frame. Returns the timeline
        with late closures moved, and whether a closure was moved for the first time.
        """
        start_s, end_s = timeline.apex_start_s, timeline.apex_end_s
        is_new = is_moved = False
        for row in self._closing_rows(timeline):
            index = int(timeline.phone_index[row])
            if index not in self._postponed_s:
                if index in self._shown or not last_s - _MAX_LATE_S < end_s[row] < time_s:
                    continue
                self._postponed_s[index] = last_s + _CATCH_UP_S
                is_new = True
            if not is_moved:
                start_s, end_s, is_moved = start_s.copy(), end_s.copy(), True
            end_s[row] = max(end_s[row], self._postponed_s[index])
            start_s[row] = max(start_s[row], min(self._postponed_s[index], end_s[row]))
        if not is_moved:
            return timeline, False
        moved = replace(timeline, apex_start_s=start_s, apex_end_s=end_s)
        return moved.select(np.argsort(start_s, kind="stable")), is_new

    def shorten(self, duration_s: Doubles, timeline: Timeline, time_s: float) -> Doubles:
        """Shorten a transition that starts at ``time_s`` so that it ends before the next closures.

        ``duration_s`` and the result have shape (num_mouth_faps,).
        """
        shortened = duration_s.copy()
        for row in self._closing_rows(timeline):
            if timeline.apex_end_s[row] > time_s:
                left_s = max(timeline.apex_start_s[row] - time_s, _MIN_TRANSITION_S)
                closes = self._closes[timeline.viseme[row]]
                shortened[closes] = np.minimum(shortened[closes], left_s)
        return shortened

    def record_closures(self, timeline: Timeline, time_s: float, mouth: Doubles) -> None:
        """Record which closures the mouth, FAPs (num_mouth_faps,), shows at a time."""
        for row in self._closing_rows(timeline):
            if timeline.apex_start_s[row] - self._frame_s <= time_s:
                viseme = timeline.viseme[row]
                error = np.abs(mouth - self._target[viseme])
                if np.all(error[self._closes[viseme]] < _CLOSED_DISTANCE):
                    self._shown.add(int(timeline.phone_index[row]))

    def forget(self, indices: Iterable[int]) -> None:
        """Forget phones."""
        for index in indices:
            self._shown.discard(index)
            self._postponed_s.pop(index, None)

    def flush(self) -> None:
        """Forget all phones."""
        self._shown.clear()
        self._postponed_s.clear()

    def _closing_rows(self, timeline: Timeline) -> NDArray[np.intp]:
        return self._any_closes[timeline.viseme].nonzero()[0]
