"""Finds stressed syllables, ends of phrases and questions from levels and pitches.

A syllable is stressed while its level and pitch exceed those of the last seconds:

    p = (level - mean) / spread + (pitch - mean) / spread > 1.2

with the pitch in semitones and its term limited to -1 to 1. A phrase ends with a short silence. It
is a question if its pitch ends high and rises:

    final - lowest of the last 0.5 s of voice > 3 semitones,   final - mean > 1.3 spread

``final`` is the mean of the last 60 ms of voice. Rising tones of Mandarin rarely end this high.
Most questions with a question word do not rise.
"""

import math
from collections import deque
from dataclasses import dataclass

from kouxing.services.synthesizer.modifiers.modifier import FrameContext, pop_until
from kouxing.shared.face.smoothing import smoothing_gain

_LEAD_S = 0.06  # levels act this much earlier, if known, to compensate for the filters
_LEVEL_S = 0.03  # time constant of the level
_MEAN_S = 3.0  # time constant of means and spreads
_INITIAL_DB, _INITIAL_SPREAD_DB = -26.0, 5.0  # dBFS
_PAUSE_DB = 15.0  # levels this far below the mean are not speech
_STRESS = 1.2  # spreads above the mean
_INITIAL_SPREAD_ST = 3.0  # semitones
_MIN_SPREAD_DB, _MIN_SPREAD_ST = 2.0, 1.0
_PHRASE_S, _PHRASE_END_S = 1.2, 0.2  # duration of a phrase, and of the silence after it
_FINAL_S, _RISE_S, _RISE_ST, _RISE_SPREADS = 0.06, 0.5, 3.0, 1.3


@dataclass(slots=True)
class Prosody:
    """The prosody of one session at a frame."""

    stress: float = 0.0  # p of the current stressed syllable, otherwise 0
    silence_s: float = math.inf  # since the last speech
    phrase_s: float = 0.0  # duration of speech in the current phrase
    relative_pitch: float = 0.0  # pitch relative to the mean, in spreads, -1 to 1
    phrase_ended: bool = False  # whether a phrase has ended at this frame
    is_question: bool = False  # the phrase has ended with a rising pitch


class ProsodyTracker:
    """Tracks the prosody of one session, frame by frame."""

    def __init__(self) -> None:
        self._now = Prosody()
        self._levels: deque[tuple[float, float]] = deque()
        self._pitches: deque[tuple[float, float]] = deque()
        self._level_s = 0.0  # media time of the last level
        self._level_db = self._mean_db = _INITIAL_DB
        self._spread_db = _INITIAL_SPREAD_DB
        self._pitch_s = 0.0  # media time of the last pitch
        self._mean_st = math.nan  # no pitch is known yet
        self._spread_st = _INITIAL_SPREAD_ST
        self._recent: deque[tuple[float, float]] = deque()  # media time, semitones

    def update(self, context: FrameContext) -> Prosody:
        """Return the prosody at a frame. The object is valid until the next call."""
        now = self._now
        self._levels += context.levels
        self._pitches += context.pitches
        until_s = min(context.known_s, context.time_s + _LEAD_S)
        before_s = now.silence_s
        now.silence_s += context.step_s
        for time_s, pitch_hz in pop_until(self._pitches, until_s):
            self._add_pitch(time_s, pitch_hz)
        for time_s, level_db in pop_until(self._levels, until_s):
            if context.is_speaking:  # otherwise it is noise
                self._add_level(time_s, level_db)
        now.phrase_ended = now.phrase_s > _PHRASE_S and before_s < _PHRASE_END_S <= now.silence_s
        now.is_question = now.phrase_ended and self._pitch_rises()
        if now.silence_s >= _PHRASE_END_S:
            now.phrase_s = 0.0 if now.phrase_ended else now.phrase_s
            now.stress = 0.0
        return now

    def _add_pitch(self, time_s: float, pitch_hz: float) -> None:
        elapsed_s = min(max(time_s - self._pitch_s, 0.0), 1.0)
        self._pitch_s = time_s
        pitch_st = 12.0 * math.log2(pitch_hz)
        if math.isnan(self._mean_st):
            self._mean_st = pitch_st
        above_st = pitch_st - self._mean_st
        spread_st = max(self._spread_st, _MIN_SPREAD_ST)
        self._now.relative_pitch = min(max(above_st / spread_st, -1.0), 1.0)
        self._mean_st += above_st * smoothing_gain(elapsed_s, _MEAN_S)
        self._spread_st += (abs(above_st) - self._spread_st) * smoothing_gain(elapsed_s, _MEAN_S)
        self._recent.append((time_s, pitch_st))
        while self._recent[0][0] < time_s - _RISE_S:
            self._recent.popleft()

    def _add_level(self, time_s: float, level_db: float) -> None:
        now = self._now
        elapsed_s = min(max(time_s - self._level_s, 0.0), 1.0)
        self._level_s = time_s
        self._level_db += (level_db - self._level_db) * smoothing_gain(elapsed_s, _LEVEL_S)
        above_db = self._level_db - self._mean_db
        if above_db < -_PAUSE_DB:
            now.stress = 0.0
            return
        now.silence_s = 0.0
        now.phrase_s += elapsed_s
        self._mean_db += above_db * smoothing_gain(elapsed_s, _MEAN_S)
        self._spread_db += (abs(above_db) - self._spread_db) * smoothing_gain(elapsed_s, _MEAN_S)
        prominence = above_db / max(self._spread_db, _MIN_SPREAD_DB) + now.relative_pitch
        now.stress = prominence if prominence > _STRESS else 0.0

    def _pitch_rises(self) -> bool:
        final = [pitch for time_s, pitch in self._recent if time_s > self._pitch_s - _FINAL_S]
        if not final:
            return False
        final_st = sum(final) / len(final)
        lowest_st = min(pitch for _, pitch in self._recent)
        high_st = self._mean_st + _RISE_SPREADS * max(self._spread_st, _MIN_SPREAD_ST)
        return final_st > max(high_st, lowest_st + _RISE_ST)
