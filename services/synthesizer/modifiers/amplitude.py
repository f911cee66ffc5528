"""Scales mouth openings with the level of the voice and the rate of speech.

Louder speech opens jaw and lips further (Lombard speech; Schulman 1989), fast speech less. Zhang
2021 names both as open questions. Only openings are scaled, so closures stay closed.

The level is compared with the usual level of the current viseme, because open vowels are naturally
louder than closed ones, and with the speaker's mean, so that microphone gain has no effect. Levels
are known immediately, phones about 0.1 s later. With a short delay, a level above the usual level
of the known phone therefore predicts the next vowel. The speaking rate acts twice. Blending makes
fast visemes miss their targets, which explains about half of the reduction in real lips;
`_PER_RATE` is the other half (see docs/visemes.md).
"""

from collections import deque

import numpy as np

from kouxing.services.synthesizer.lips.lip_model import Articulation
from kouxing.services.synthesizer.modifiers.modifier import FrameContext, pop_until
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.face.faps import LIP_HEIGHT_FAPS
from kouxing.shared.face.smoothing import TwoPoleFilter

_PER_DB = 0.03
_MAX_DB = 15.0  # larger level differences are clipped
_PAUSE_DB = 25.0  # levels this far below the mean are not speech
_INITIAL_MEAN_DB = -26.0  # dBFS
_INITIAL_MEAN_LEVELS = 10.0  # weight of the initial mean, in levels
_MAX_MEAN_LEVELS = 300.0  # adaptation period of the speaker's mean, in levels
_LEAD_S = 0.05  # levels act this much earlier, if known, to compensate for the filter
_FILTER_S = 0.025  # time constant of each pole; slower filters match real lips less well

_USUAL_RATE_HZ = 5.0  # syllables per second
_PER_RATE = -0.03
_NUM_INTERVALS = 4  # syllable intervals in a rate measurement
_MAX_INTERVAL_S = 0.6  # longer intervals are pauses
_MIN_GAIN, _MAX_GAIN = 0.4, 1.4

# FAPs that open the mouth, and the sign of opening
_OPENING = {3: 1.0} | dict.fromkeys(LIP_HEIGHT_FAPS, -1.0)
_OPENING_FAPS = np.array(list(_OPENING)) - 1
_OPENING_SIGNS = np.array(list(_OPENING.values()), dtype=np.float32)


class AmplitudeModifier:
    """Multiplies mouth openings by a smooth gain."""

    def __init__(self) -> None:
        self._levels: deque[tuple[float, float]] = deque()
        self._mean_db = _INITIAL_MEAN_DB
        self._num_levels = _INITIAL_MEAN_LEVELS
        self._goal = 1.0
        self._gain = TwoPoleFilter(1.0)

    def apply(self, faps: Floats, context: FrameContext) -> None:
        """Scale the openings of a frame, FAPs (68,), in place."""
        self._levels += context.levels
        until_s = min(context.known_s, context.time_s + _LEAD_S)
        for time_s, level_db in pop_until(self._levels, until_s):
            self._add_level(context.articulation, time_s, level_db)
        goal = 1.0
        if context.amplitude_applies:
            goal = self._goal * _rate_gain(context.articulation.syllable_onsets_s, until_s)
            goal = min(max(goal, _MIN_GAIN), _MAX_GAIN)
        gain = self._gain.step(goal, context.step_s, _FILTER_S)
        if gain != 1.0:
            opening = faps[_OPENING_FAPS]
            faps[_OPENING_FAPS] = np.where(
                opening * _OPENING_SIGNS > 0.0, opening * np.float32(gain), opening
            )

    def _add_level(self, articulation: Articulation, time_s: float, level_db: float) -> None:
        usual_db = articulation.usual_level_db(time_s)
        if usual_db is None or level_db < self._mean_db - _PAUSE_DB:
            return
        level_db -= usual_db
        self._num_levels = min(self._num_levels + 1.0, _MAX_MEAN_LEVELS)
        self._mean_db += (level_db - self._mean_db) / self._num_levels
        louder_db = min(max(level_db - self._mean_db, -_MAX_DB), _MAX_DB)
        self._goal = 1.0 + _PER_DB * louder_db


def _rate_gain(syllable_onsets_s: Doubles, until_s: float) -> float:
    """Return the gain for the rate of the last syllables before ``until_s``."""
    num_started = int(syllable_onsets_s.searchsorted(until_s, side="right"))
    intervals = np.diff(syllable_onsets_s[max(num_started - _NUM_INTERVALS - 1, 0) : num_started])
    intervals = intervals[(intervals > 0.0) & (intervals < _MAX_INTERVAL_S)]
    if not intervals.size:
        return 1.0
    return 1.0 + _PER_RATE * (1.0 / float(intervals.mean()) - _USUAL_RATE_HZ)
