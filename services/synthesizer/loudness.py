"""How far the mouth opens with the level of the voice.

Louder speech opens jaw and lips further (Lombard speech; Schulman 1989), by about a fifth at most
here. Levels are compared with the speaker's own running mean, so the microphone's gain does not
matter. What is shut stays shut, since only openings are scaled.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

_GAIN_PER_DB = 0.02
_LOWEST_GAIN, _HIGHEST_GAIN = 0.8, 1.2
_USUAL_DB = -26.0  # dBFS, until the speaker is known
_PAUSE_DB = 20.0  # a level so far below the mean is no speech
_ADAPT_LEVELS = 300.0  # the mean follows within so many levels
_FOLLOW_S = 0.25

# FAPs that open the mouth, and the sign of opening
_OPENING = {3: 1.0} | dict.fromkeys((4, 5, 8, 9, 10, 11, 51, 52, 55, 56, 57, 58), -1.0)
_OPENING_FAPS = np.array(list(_OPENING)) - 1
_OPENING_SIGNS = np.array(list(_OPENING.values()), dtype=np.float32)


class Loudness:
    """A slow gain for the opening of the mouth; 1 as long as no level comes."""

    def __init__(self) -> None:
        self._levels: deque[tuple[float, float]] = deque()
        self._mean_db = _USUAL_DB
        self._goal = 1.0
        self._halfway = self._gain = 1.0  # two filters in a row: no corner in the gain

    def accept_level(self, time_s: float, level_db: float) -> None:
        """Take a level in dB of full scale around a time in seconds."""
        if math.isfinite(time_s) and math.isfinite(level_db):
            self._levels.append((time_s, level_db))

    def scale(self, faps: NDArray[np.float32], known_s: float, step_s: float) -> None:
        """Scale the openings of a frame, (68,), in place, with the levels up to ``known_s``."""
        while self._levels and self._levels[0][0] <= known_s:
            level_db = self._levels.popleft()[1]
            if level_db < self._mean_db - _PAUSE_DB:
                continue
            self._mean_db += (level_db - self._mean_db) / _ADAPT_LEVELS
            gain = 1.0 + _GAIN_PER_DB * (level_db - self._mean_db)
            self._goal = min(max(gain, _LOWEST_GAIN), _HIGHEST_GAIN)
        share = -math.expm1(-step_s / _FOLLOW_S)
        self._halfway += (self._goal - self._halfway) * share
        self._gain += (self._halfway - self._gain) * share
        if self._gain != 1.0:
            opening = faps[_OPENING_FAPS]
            faps[_OPENING_FAPS] = np.where(
                opening * _OPENING_SIGNS > 0.0, opening * np.float32(self._gain), opening
            )
