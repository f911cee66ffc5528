"""How far the mouth opens: with the level of the voice, and with the rate of speech.

Louder speech opens jaw and lips further (Lombard speech; Schulman 1989), fast speech less: Zhang
2021 names both as open. What is shut stays shut, since only openings are scaled.

The level is compared with what is usual for the viseme that is said (an open vowel is louder than
a closed one without any effort) and for the speaker, so that the microphone's gain does not
matter. Levels are known at once, phones a tenth of a second later: with a short delay, a level
above that of the phone known so far also foretells the next vowel.

The rate counts twice. Visemes that follow each other fast fall short of their targets by blending,
which explains about half of what lips show; the other half is `_PER_RATE` (see docs/visemes.md).
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.lip_model import Articulation
from kouxing.services.synthesizer.modifiers.modifier import Moment

_PER_DB = 0.03
_MAX_DB = 15.0  # of a difference that counts
_PAUSE_DB = 25.0  # a level this far below the mean is no speech
_INITIAL_MEAN_DB = -26.0  # dBFS, until the speaker is known
_INITIAL_MEAN_LEVELS = 10.0  # weight of that, in levels
_MAX_MEAN_LEVELS = 300.0  # the speaker's mean adapts over this many
_LEAD_S = 0.05  # levels are used this long before their frame, if known: the filters' delay
_FILTER_S = 0.025  # time constant of each of two filters; slower ones fit real lips worse

_USUAL_RATE_HZ = 5.0  # syllables per second
_PER_RATE = -0.03
_NUM_INTERVALS = 4  # between syllables, from which the rate is measured
_MAX_INTERVAL_S = 0.6  # longer ones are pauses
_MIN_GAIN, _MAX_GAIN = 0.4, 1.4

# FAPs that open the mouth, and the sign of opening
_OPENING = {3: 1.0} | dict.fromkeys((4, 5, 8, 9, 10, 11, 51, 52, 55, 56, 57, 58), -1.0)
_OPENING_FAPS = np.array(list(_OPENING)) - 1
_OPENING_SIGNS = np.array(list(_OPENING.values()), dtype=np.float32)


class Amplitude:
    """A gain for the opening of the mouth, smooth whatever comes."""

    def __init__(self) -> None:
        self._levels: deque[tuple[float, float]] = deque()
        self._mean_db = _INITIAL_MEAN_DB
        self._num_levels = _INITIAL_MEAN_LEVELS
        self._goal = 1.0
        self._halfway = self._gain = 1.0  # two filters in a row: no corner in the gain

    def apply(self, faps: NDArray[np.float32], moment: Moment) -> None:
        """Scale the openings of a frame, FAPs (68,), in place."""
        self._levels += [level for level in moment.levels if all(map(math.isfinite, level))]
        until_s = min(moment.known_s, moment.time_s + _LEAD_S)
        while self._levels and self._levels[0][0] <= until_s:
            self._follow_level(moment.articulation, *self._levels.popleft())
        goal = self._goal * _rate_gain(moment.articulation.syllable_onsets_s, until_s)
        goal = min(max(goal, _MIN_GAIN), _MAX_GAIN) if moment.amplitude_applies else 1.0
        share = -math.expm1(-moment.step_s / _FILTER_S)
        self._halfway += (goal - self._halfway) * share
        self._gain += (self._halfway - self._gain) * share
        if self._gain != 1.0:
            opening = faps[_OPENING_FAPS]
            faps[_OPENING_FAPS] = np.where(
                opening * _OPENING_SIGNS > 0.0, opening * np.float32(self._gain), opening
            )

    def _follow_level(self, articulation: Articulation, time_s: float, level_db: float) -> None:
        usual_db = articulation.usual_level_db(time_s)
        if usual_db is None or level_db < self._mean_db - _PAUSE_DB:
            return
        level_db -= usual_db
        self._num_levels = min(self._num_levels + 1.0, _MAX_MEAN_LEVELS)
        self._mean_db += (level_db - self._mean_db) / self._num_levels
        louder_db = min(max(level_db - self._mean_db, -_MAX_DB), _MAX_DB)
        self._goal = 1.0 + _PER_DB * louder_db


def _rate_gain(syllable_onsets_s: NDArray[np.float64], until_s: float) -> float:
    """Gain for the rate of the last syllables that began before ``until_s``."""
    num_begun = int(np.searchsorted(syllable_onsets_s, until_s, side="right"))
    intervals = np.diff(syllable_onsets_s[max(num_begun - _NUM_INTERVALS - 1, 0) : num_begun])
    intervals = intervals[(intervals > 0.0) & (intervals < _MAX_INTERVAL_S)]
    if not intervals.size:
        return 1.0
    return 1.0 + _PER_RATE * (1.0 / float(intervals.mean()) - _USUAL_RATE_HZ)
