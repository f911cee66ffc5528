"""Brows, head and eyes that go with speech, on top of idle motion.

Speakers raise their brows and dip their heads with stressed syllables, and nod when a phrase ends
(Graf et al. 2002; Swerts & Krahmer 2010); not always, and not always as far, which is drawn at
random. A syllable is stressed that stands out from those of the last seconds, by its level and by
its pitch:

    (level - mean) / spread + (pitch - mean) / spread > 1.2

with the pitch in semitones, and its term between -1 and 1. In pauses the eyes leave the listener
more often.

Two filters in a row make each movement smooth. No FAP of the mouth is touched, and everything
follows from the seed and the sound.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.modifiers.modifier import Moment
from kouxing.shared.face.faps import FAP_NUMBER, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.idle_motion import IdleMotion, State

_LEAD_S = 0.06  # levels are used this long before their frame, if known: the filters' delay
_LEVEL_S = 0.03  # time constants: of the level,
_USUAL_S = 3.0  # and of what is usual
_FIRST_DB, _FIRST_SPREAD_DB = -26.0, 5.0  # dBFS, until the speaker is known
_PAUSE_DB = 15.0  # a level this far below the mean is no speech
_STRESS = 1.2  # spreads above the mean
_FIRST_SPREAD_ST = 3.0  # semitones
_LEAST_SPREAD_DB, _LEAST_SPREAD_ST = 2.0, 1.0
_STRESS_EVERY_S = 0.8  # at most
_PHRASE_S, _PHRASE_END_S = 0.8, 0.14  # speech before a nod, and silence
_THINKING_S = (0.7, 2.5)  # of silence

_BROW_SHARE, _BEAT_SHARE, _NOD_SHARE = 0.55, 0.7, 0.85  # of the occasions
_LEAST = 0.5  # of a movement's size, at random
_OCCASION_S = 0.2  # within which it is the same chance
_BROW_HELD_S, _BEAT_HELD_S, _NOD_HELD_S = 0.22, 0.12, 0.2
_FILTER_S = 0.08  # time constant of each of two filters
_BROW = {  # FAP units of a full movement
    f"raise_{side}_{part}_eyebrow": units
    for side in "lr"
    for part, units in (("i", 45.0), ("m", 55.0), ("o", 35.0))
}
_BEAT_DEG, _NOD_DEG = 2.4, 3.2  # downwards; the filters leave about half of it

_BROWS = np.array([FAP_NUMBER[name] - 1 for name in _BROW])
_BROW_UNITS = np.array([*_BROW.values()], np.float32)
_HEAD_PITCH = FAP_NUMBER["head_pitch"] - 1
_EYES_PITCH = [FAP_NUMBER["pitch_l_eyeball"] - 1, FAP_NUMBER["pitch_r_eyeball"] - 1]
_DEGREE = math.radians(1.0) / RADIANS_PER_ANGLE_UNIT


class Life:
    """Idle motion, and what goes with speech.

    Parameters
    ----------
    seed
        The same seed and sound give the same motion.
    """

    def __init__(self, seed: int) -> None:
        self._idle = IdleMotion(seed)
        self._seed = seed
        self._levels: deque[tuple[float, float]] = deque()
        self._pitches: deque[tuple[float, float]] = deque()
        self._level_s = 0.0  # media time of the last level
        self._level_db = self._mean_db = _FIRST_DB
        self._spread_db = _FIRST_SPREAD_DB
        self._pitch_s = 0.0  # media time of the last pitch
        self._mean_st = math.nan  # nothing is known of the voice
        self._spread_st = _FIRST_SPREAD_ST
        self._raised = 0.0  # pitch above the mean, in spreads
        self._is_stressed = False
        self._phrase_s = 0.0  # speech since the last end of a phrase
        self._silence_s = math.inf
        self._stress_s = -math.inf  # of the last stress, since the first frame
        self._brow, self._head = _Movement(), _Movement()

    def apply(self, faps: NDArray[np.float32], moment: Moment) -> None:
        """Add the motion to a frame, FAPs (68,), in place."""
        now_s, step_s = moment.elapsed_s, moment.step_s
        self._levels += [level for level in moment.levels if all(map(math.isfinite, level))]
        until_s = min(moment.known_s, moment.time_s + _LEAD_S)
        before_s = self._silence_s
        self._silence_s += step_s
        self._pitches += moment.pitches
        while self._pitches and self._pitches[0][0] <= until_s:
            self._follow_pitch(*self._pitches.popleft())
        while self._levels and self._levels[0][0] <= until_s:
            time_s, level_db = self._levels.popleft()
            if moment.is_speaking:  # else it is noise
                self._follow_level(time_s, level_db, now_s)
        if self._phrase_s > _PHRASE_S and before_s < _PHRASE_END_S <= self._silence_s:
            self._phrase_s = 0.0
            self._move(self._head, _NOD_SHARE, _NOD_DEG, now_s, _NOD_HELD_S)
        self._idle.apply(faps, now_s, self._state())
        faps[_BROWS] += np.float32(self._brow.at(now_s, step_s)) * _BROW_UNITS
        pitch = np.float32(self._head.at(now_s, step_s) * _DEGREE)
        faps[_HEAD_PITCH] += pitch
        faps[_EYES_PITCH] -= pitch  # the eyes stay on what they look at

    def _state(self) -> State:
        if self._silence_s < _THINKING_S[0]:
            return State.SPEAKING
        return State.THINKING if self._silence_s < _THINKING_S[1] else State.LISTENING

    def _follow_pitch(self, time_s: float, pitch_hz: float) -> None:
        elapsed_s = min(max(time_s - self._pitch_s, 0.0), 1.0)
        self._pitch_s = time_s
        pitch_st = 12.0 * math.log2(pitch_hz)
        if math.isnan(self._mean_st):
            self._mean_st = pitch_st
        above_st = pitch_st - self._mean_st
        self._raised = min(max(above_st / max(self._spread_st, _LEAST_SPREAD_ST), -1.0), 1.0)
        self._mean_st += above_st * _share(elapsed_s, _USUAL_S)
        self._spread_st += (abs(above_st) - self._spread_st) * _share(elapsed_s, _USUAL_S)

    def _follow_level(self, time_s: float, level_db: float, now_s: float) -> None:
        elapsed_s = min(max(time_s - self._level_s, 0.0), 1.0)
        self._level_s = time_s
        self._level_db += (level_db - self._level_db) * _share(elapsed_s, _LEVEL_S)
        above_db = self._level_db - self._mean_db
        if above_db < -_PAUSE_DB:
            self._is_stressed = False
            return
        self._silence_s = 0.0
        self._phrase_s += elapsed_s
        self._mean_db += above_db * _share(elapsed_s, _USUAL_S)
        self._spread_db += (abs(above_db) - self._spread_db) * _share(elapsed_s, _USUAL_S)
        was_stressed = self._is_stressed
        louder = above_db / max(self._spread_db, _LEAST_SPREAD_DB)
        self._is_stressed = louder + self._raised > _STRESS
        if self._is_stressed and not was_stressed and now_s - self._stress_s > _STRESS_EVERY_S:
            self._stress_s = now_s
            self._move(self._brow, _BROW_SHARE, 1.0, now_s, _BROW_HELD_S)
            self._move(self._head, _BEAT_SHARE, _BEAT_DEG, now_s, _BEAT_HELD_S)

    def _move(
        self, movement: _Movement, share: float, size: float, now_s: float, held_s: float
    ) -> None:
        """Begin a movement, or not, by chance: at the same time always the same."""
        occasion = round(now_s / _OCCASION_S)
        draw = 2 * occasion + (movement is self._head)
        chance, scale = np.random.default_rng([self._seed, 1, draw]).random(2)
        if chance < share:
            movement.begin(size * (_LEAST + (1.0 - _LEAST) * float(scale)), now_s + held_s)


class _Movement:
    """Goes to a size, stays until a time, and comes back."""

    def __init__(self) -> None:
        self._size, self._until_s = 0.0, -math.inf
        self._halfway = self._value = 0.0

    def begin(self, size: float, until_s: float) -> None:
        self._size, self._until_s = size, until_s

    def at(self, now_s: float, step_s: float) -> float:
        goal = self._size if now_s < self._until_s else 0.0
        share = _share(step_s, _FILTER_S)
        self._halfway += (goal - self._halfway) * share
        self._value += (self._halfway - self._value) * share
        return self._value


def _share(elapsed_s: float, time_constant_s: float) -> float:
    return -math.expm1(-elapsed_s / time_constant_s)
