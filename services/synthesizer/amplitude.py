"""How far the mouth opens: with the level of the voice, and with the rate of speech.

Louder speech opens jaw and lips further (Lombard speech; Schulman 1989), fast speech less: Zhang
2021 names both as open. What is shut stays shut, since only openings are scaled.

The level is compared with what is usual for the viseme that is said (an open vowel is louder than
a closed one without any effort) and for the speaker, so that the microphone's gain does not
matter. Levels are known at once, units a tenth of a second later: with a short look-ahead a level
above that of the unit known so far also foretells the next vowel.

The rate counts twice: visemes that follow each other fast fall short of their targets (`blending`),
which explains about half of what lips show; the other half is `_PER_RATE` (see docs/visemes.md).
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.timeline import Timeline

_PER_DB = 0.03
_LARGEST_DB = 15.0  # of a difference that counts
_PAUSE_DB = 25.0  # a level so far below the mean is no speech
_USUAL_DB = -26.0  # dBFS, until the speaker is known
_DOUBT_LEVELS = 10.0  # how many levels that is worth
_MEMORY_LEVELS = 300.0  # the speaker's mean follows within so many
_LEAD_S = 0.05  # levels are taken so long before their frame, if they are known: the filters' delay
_FOLLOW_S = 0.025  # of each of two filters; slower ones fit real lips worse

_USUAL_RATE_HZ = 5.0  # syllables a second
_PER_RATE = -0.03
_NUM_INTERVALS = 4  # between syllables, from which the rate is measured
_LONGEST_INTERVAL_S = 0.6  # longer ones are pauses
_LOWEST_GAIN, _HIGHEST_GAIN = 0.4, 1.4

# FAPs that open the mouth, and the sign of opening
_OPENING = {3: 1.0} | dict.fromkeys((4, 5, 8, 9, 10, 11, 51, 52, 55, 56, 57, 58), -1.0)
_OPENING_FAPS = np.array(list(_OPENING)) - 1
_OPENING_SIGNS = np.array(list(_OPENING.values()), dtype=np.float32)


class Amplitude:
    """A gain for the opening of the mouth, smooth whatever comes.

    Parameters
    ----------
    usual_level_db : array (num_visemes,)
        Level of each viseme beside the speaker's mean.
    """

    def __init__(self, usual_level_db: NDArray[np.float64]) -> None:
        self._usual_db = usual_level_db
        self._levels: deque[tuple[float, float]] = deque()
        self._mean_db = _USUAL_DB
        self._num_levels = _DOUBT_LEVELS
        self._goal = 1.0
        self._halfway = self._gain = 1.0  # two filters in a row: no corner in the gain

    def accept_level(self, time_s: float, level_db: float) -> None:
        """Take a level in dB of full scale around a time in seconds."""
        if math.isfinite(time_s) and math.isfinite(level_db):
            self._levels.append((time_s, level_db))

    def scale(
        self,
        faps: NDArray[np.float32],
        timeline: Timeline,
        time_s: float,
        known_s: float,
        step_s: float,
    ) -> None:
        """Scale the openings of a frame.

        Parameters
        ----------
        faps : array (68,)
            Changed in place, FAP units.
        timeline : Timeline
            What is said.
        time_s : float
            Of the frame, seconds.
        known_s : float
            Levels up to this time may be used.
        step_s : float
            Time since the last frame.
        """
        until_s = min(known_s, time_s + _LEAD_S)
        while self._levels and self._levels[0][0] <= until_s:
            self._follow_level(timeline, *self._levels.popleft())
        goal = self._goal * _rate_gain(timeline, until_s)
        goal = min(max(goal, _LOWEST_GAIN), _HIGHEST_GAIN)
        share = -math.expm1(-step_s / _FOLLOW_S)
        self._halfway += (goal - self._halfway) * share
        self._gain += (self._halfway - self._gain) * share
        if self._gain != 1.0:
            opening = faps[_OPENING_FAPS]
            faps[_OPENING_FAPS] = np.where(
                opening * _OPENING_SIGNS > 0.0, opening * np.float32(self._gain), opening
            )

    def _follow_level(self, timeline: Timeline, time_s: float, level_db: float) -> None:
        if not len(timeline.viseme) or level_db < self._mean_db - _PAUSE_DB:
            return
        distance_s = np.maximum(timeline.centre_start_s - time_s, time_s - timeline.centre_end_s)
        level_db -= self._usual_db[timeline.viseme[np.argmin(distance_s)]]
        self._num_levels = min(self._num_levels + 1.0, _MEMORY_LEVELS)
        self._mean_db += (level_db - self._mean_db) / self._num_levels
        louder_db = min(max(level_db - self._mean_db, -_LARGEST_DB), _LARGEST_DB)
        self._goal = 1.0 + _PER_DB * louder_db


def _rate_gain(timeline: Timeline, until_s: float) -> float:
    """Gain for the rate of the last syllables that began before ``until_s``."""
    begun = int(np.searchsorted(timeline.syllable_s, until_s, side="right"))
    intervals = np.diff(timeline.syllable_s[max(begun - _NUM_INTERVALS - 1, 0) : begun])
    intervals = intervals[(intervals > 0.0) & (intervals < _LONGEST_INTERVAL_S)]
    if not intervals.size:
        return 1.0
    return 1.0 + _PER_RATE * (1.0 / float(intervals.mean()) - _USUAL_RATE_HZ)
