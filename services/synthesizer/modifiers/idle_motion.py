"""Idle motion, and brow, head and eye motion that accompanies speech.

Speakers raise their brows and dip their heads on stressed syllables, and nod at the end of a phrase
(Graf et al. 2002; Swerts & Krahmer 2010). Occurrence and size are random. A syllable is stressed if
its level and pitch stand out from the last seconds:

    (level - mean) / spread + (pitch - mean) / spread > 1.2

with the pitch in semitones and its term limited to -1 to 1. In pauses the eyes leave the listener
more often. A two-pole filter smooths each movement. Mouth FAPs are not changed, and the motion
depends only on the seed and the sound.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.face.faps import FAP_NUMBER, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.idle_motion import EYES_PITCH, IdleMotion, State, span
from kouxing.shared.face.smoothing import TwoPoleFilter, smoothing_share

_LEAD_S = 0.06  # levels act this long before their frame, if known: the delay of the filter
_LEVEL_S = 0.03  # time constant of the level
_MEAN_S = 3.0  # time constant of means and spreads
_INITIAL_DB, _INITIAL_SPREAD_DB = -26.0, 5.0  # dBFS
_PAUSE_DB = 15.0  # levels this far below the mean are not speech
_STRESS = 1.2  # spreads above the mean
_INITIAL_SPREAD_ST = 3.0  # semitones
_MIN_SPREAD_DB, _MIN_SPREAD_ST = 2.0, 1.0
_MIN_STRESS_INTERVAL_S = 0.8
_PHRASE_S, _PHRASE_END_S = 0.8, 0.14  # duration of speech before a nod, and of silence
_THINKING_S = (0.7, 2.5)  # duration of silence

_BROW_SHARE, _BEAT_SHARE, _NOD_SHARE = 0.55, 0.7, 0.85  # probabilities of movements
_MIN_SIZE = 0.5  # minimum of the random size
_OCCASION_S = 0.2  # period with a single random decision
_BROW_HOLD_S, _BEAT_HOLD_S, _NOD_HOLD_S = 0.22, 0.12, 0.2
_FILTER_S = 0.08  # time constant of each filter pole
_BROW = {  # FAP units of a full movement
    f"raise_{side}_{part}_eyebrow": units
    for part, units in (("i", 45.0), ("m", 55.0), ("o", 35.0))
    for side in "lr"
}
_BEAT_DEG, _NOD_DEG = 2.4, 3.2  # downwards; the filter halves these sizes

_BROWS = span("raise_l_i_eyebrow", "raise_r_o_eyebrow")
_BROW_UNITS = np.array([*_BROW.values()], np.float32)
_HEAD_PITCH = FAP_NUMBER["head_pitch"] - 1
_DEGREE = math.radians(1.0) / RADIANS_PER_ANGLE_UNIT


class SpeechIdleMotion:
    """Idle motion with movements that accompany speech; seed and sound define the motion."""

    def __init__(self, seed: int) -> None:
        self._idle = IdleMotion(seed)
        self._seed = seed
        self._levels: deque[tuple[float, float]] = deque()
        self._pitches: deque[tuple[float, float]] = deque()
        self._level_s = 0.0  # media time of the last level
        self._level_db = self._mean_db = _INITIAL_DB
        self._spread_db = _INITIAL_SPREAD_DB
        self._pitch_s = 0.0  # media time of the last pitch
        self._mean_st = math.nan  # no pitch is known yet
        self._spread_st = _INITIAL_SPREAD_ST
        self._raised = 0.0  # pitch above the mean, in spreads
        self._is_stressed = False
        self._phrase_s = 0.0  # duration of speech since the last end of a phrase
        self._silence_s = math.inf
        self._stress_s = -math.inf  # time of the last stress, since the first frame
        self._brow, self._head = _Movement(), _Movement()

    def apply(self, faps: NDArray[np.float32], context: FrameContext) -> None:
        """Add the motion to a frame, FAPs (68,), in place."""
        now_s, step_s = context.elapsed_s, context.step_s
        self._levels += [level for level in context.levels if all(map(math.isfinite, level))]
        until_s = min(context.known_s, context.time_s + _LEAD_S)
        before_s = self._silence_s
        self._silence_s += step_s
        self._pitches += context.pitches
        while self._pitches and self._pitches[0][0] <= until_s:
            self._add_pitch(*self._pitches.popleft())
        while self._levels and self._levels[0][0] <= until_s:
            time_s, level_db = self._levels.popleft()
            if context.is_speaking:  # otherwise it is noise
                self._add_level(time_s, level_db, now_s)
        if self._phrase_s > _PHRASE_S and before_s < _PHRASE_END_S <= self._silence_s:
            self._phrase_s = 0.0
            self._move(self._head, _NOD_SHARE, _NOD_DEG, now_s, _NOD_HOLD_S)
        self._idle.apply(faps, now_s, self._state())
        faps[_BROWS] += np.float32(self._brow.at(now_s, step_s)) * _BROW_UNITS
        pitch = np.float32(self._head.at(now_s, step_s) * _DEGREE)
        faps[_HEAD_PITCH] += pitch
        faps[EYES_PITCH] -= pitch  # the gaze target stays in place

    def _state(self) -> State:
        if self._silence_s < _THINKING_S[0]:
            return State.SPEAKING
        return State.THINKING if self._silence_s < _THINKING_S[1] else State.LISTENING

    def _add_pitch(self, time_s: float, pitch_hz: float) -> None:
        elapsed_s = min(max(time_s - self._pitch_s, 0.0), 1.0)
        self._pitch_s = time_s
        pitch_st = 12.0 * math.log2(pitch_hz)
        if math.isnan(self._mean_st):
            self._mean_st = pitch_st
        above_st = pitch_st - self._mean_st
        self._raised = min(max(above_st / max(self._spread_st, _MIN_SPREAD_ST), -1.0), 1.0)
        self._mean_st += above_st * smoothing_share(elapsed_s, _MEAN_S)
        self._spread_st += (abs(above_st) - self._spread_st) * smoothing_share(elapsed_s, _MEAN_S)

    def _add_level(self, time_s: float, level_db: float, now_s: float) -> None:
        elapsed_s = min(max(time_s - self._level_s, 0.0), 1.0)
        self._level_s = time_s
        self._level_db += (level_db - self._level_db) * smoothing_share(elapsed_s, _LEVEL_S)
        above_db = self._level_db - self._mean_db
        if above_db < -_PAUSE_DB:
            self._is_stressed = False
            return
        self._silence_s = 0.0
        self._phrase_s += elapsed_s
        self._mean_db += above_db * smoothing_share(elapsed_s, _MEAN_S)
        self._spread_db += (abs(above_db) - self._spread_db) * smoothing_share(elapsed_s, _MEAN_S)
        was_stressed = self._is_stressed
        louder = above_db / max(self._spread_db, _MIN_SPREAD_DB)
        self._is_stressed = louder + self._raised > _STRESS
        since_stress_s = now_s - self._stress_s
        if self._is_stressed and not was_stressed and since_stress_s > _MIN_STRESS_INTERVAL_S:
            self._stress_s = now_s
            self._move(self._brow, _BROW_SHARE, 1.0, now_s, _BROW_HOLD_S)
            self._move(self._head, _BEAT_SHARE, _BEAT_DEG, now_s, _BEAT_HOLD_S)

    def _move(
        self, movement: _Movement, share: float, size: float, now_s: float, hold_s: float
    ) -> None:
        """Start a movement at random; the decision depends only on seed and time."""
        occasion = round(now_s / _OCCASION_S)
        draw = 2 * occasion + (movement is self._head)
        chance, scale = np.random.default_rng([self._seed, 1, draw]).random(2)
        if chance < share:
            movement.start(size * (_MIN_SIZE + (1.0 - _MIN_SIZE) * float(scale)), now_s + hold_s)


class _Movement:
    """Moves to a size, stays until a time, and returns."""

    def __init__(self) -> None:
        self._size, self._until_s = 0.0, -math.inf
        self._value = TwoPoleFilter(0.0)

    def start(self, size: float, until_s: float) -> None:
        self._size, self._until_s = size, until_s

    def at(self, now_s: float, step_s: float) -> float:
        goal = self._size if now_s < self._until_s else 0.0
        return self._value.step(goal, step_s, _FILTER_S)
