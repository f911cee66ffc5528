"""Lips that must meet (b p m, f): shown late rather than never.

A closure may be recognised after its apex has passed. One that is late by less than ``_MAX_LATE_S``
is postponed to where the mouth can still show it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import VisemeParameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline

_MAX_LATE_S = 0.1  # a closure recognised later than this after its apex is not shown
_CATCH_UP_S = 0.04  # a late one takes this long
_MIN_TRANSITION_S = 0.02  # of lips that must meet at once
_CLOSED = 10.0  # a lip counts as closed within this distance of its target, FAP units


class ClosureTracker:
    """Which closures have been shown, and which are postponed.

    Parameters
    ----------
    parameters : VisemeParameters
    frame_rate_hz : float
    """

    def __init__(self, parameters: VisemeParameters, frame_rate_hz: float) -> None:
        self._target = parameters.target
        self._frame_s = 1.0 / frame_rate_hz
        self._closes: NDArray[np.bool_] = parameters.closes > 0.0  # (num_visemes, num_mouth_faps)
        self._any_closes = np.logical_or.reduce(self._closes, axis=1)  # (num_visemes,)
        self._shown: set[int] = set()  # indices of phones
        self._postponed_s: dict[int, float] = {}  # index of a phone -> its apex

    def postpone(self, timeline: Timeline, last_s: float, time_s: float) -> tuple[Timeline, bool]:
        """Move the closures whose apex passed before they were recognised.

        Parameters
        ----------
        timeline : Timeline
        last_s : float
            Time of the last frame, seconds.
        time_s : float
            Time of the next frame, seconds.

        Returns
        -------
        tuple of (Timeline, bool)
            The timeline with late closures where they can be shown, and whether one is moved for
            the first time.
        """
        start_s, end_s = timeline.apex_start_s.copy(), timeline.apex_end_s.copy()
        is_new = False
        for row in self._closing_rows(timeline):
            index = int(timeline.phone_index[row])
            if index not in self._postponed_s:
                if index in self._shown or not last_s - _MAX_LATE_S < end_s[row] < time_s:
                    continue
                self._postponed_s[index] = last_s + _CATCH_UP_S
                is_new = True
            end_s[row] = max(end_s[row], self._postponed_s[index])
            start_s[row] = max(start_s[row], min(self._postponed_s[index], end_s[row]))
        moved = replace(timeline, apex_start_s=start_s, apex_end_s=end_s)
        return moved.select(np.argsort(start_s, kind="stable")), is_new

    def shorten(
        self, duration_s: NDArray[np.float64], timeline: Timeline, time_s: float
    ) -> NDArray[np.float64]:
        """Let a transition that begins at a time end where a lip must close.

        Parameters
        ----------
        duration_s : array (num_mouth_faps,)
            Of the transition, seconds.
        timeline : Timeline
            The visemes to come.
        time_s : float
            Seconds.

        Returns
        -------
        array (num_mouth_faps,)
            Seconds, no longer than ``duration_s``.
        """
        shortened = duration_s.copy()
        for row in self._closing_rows(timeline):
            if timeline.apex_end_s[row] > time_s:
                left_s = max(timeline.apex_start_s[row] - time_s, _MIN_TRANSITION_S)
                closes = self._closes[timeline.viseme[row]]
                shortened[closes] = np.minimum(shortened[closes], left_s)
        return shortened

    def note(self, timeline: Timeline, time_s: float, mouth: NDArray[np.float64]) -> None:
        """Note which closures the mouth, FAPs (num_mouth_faps,), shows at a time."""
        for row in self._closing_rows(timeline):
            if timeline.apex_start_s[row] - self._frame_s <= time_s:
                viseme = timeline.viseme[row]
                error = np.abs(mouth - self._target[viseme])
                if np.all(error[self._closes[viseme]] < _CLOSED):
                    self._shown.add(int(timeline.phone_index[row]))

    def forget(self, indices: Iterable[int]) -> None:
        """Forget some phones."""
        for index in indices:
            self._shown.discard(index)
            self._postponed_s.pop(index, None)

    def flush(self) -> None:
        """Forget all phones."""
        self._shown.clear()
        self._postponed_s.clear()

    def _closing_rows(self, timeline: Timeline) -> NDArray[np.intp]:
        return np.flatnonzero(self._any_closes[timeline.viseme])
