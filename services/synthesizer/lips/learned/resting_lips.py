"""Moves the lips in pauses: slightly open (*ajar*) at first, closed later, open before sound.

Filmed speakers hold 0.4 to 0.6 of their range in a pause within a turn. They close within 0.4 s if
the pause lasts, and open 0.3 s before the next sound. The lip predictor shows little of this,
because half of its training data rests closed.

======  =======================================================  ====
symbol  meaning                                                  unit
======  =======================================================  ====
s       0 for the predicted mouth, 1 for a slightly open mouth   1
======  =======================================================  ====

    goal of s = 1  from the start of a pause for at most HOLD_S,
                   from the start of the audio for at most HOLD_S,
                   and from LEAD_S before voice activity to its first sound
                0  otherwise, and at an onset before the first voice activity

``s`` follows cubics, so the mouth moves smoothly. A level is a sound if it is at most ``_RANGE_DB``
below the loudest level: the maximum of recent levels and of the known levels of the next
``LEAD_S``. Silence longer than ``_MIN_PAUSE_S`` is a pause, because the closure of a stop is
shorter. In a pause, lips close for a phone, and for a likely closure shortly before a sound. If the
lip predictor is nearly certain of a closure, they stay closed until the next sound.

The first voice activity is detected too late to close the lips for an initial b, p or m. So lips
that are ajar before it also close at an *onset*: a level more than ``_ONSET_DB`` above the
background. The first level of a recording is often too low to be the background, because filters
and codecs fade in. All times are media times.
"""

import math
from collections import deque

import numpy as np

from kouxing.services.synthesizer.lips.trajectory import FapState, Transition
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import EndOfSound, Progress, SoundEvent, SpeechChange

HOLD_S = 0.85  # lips stay ajar until this time after the last sound, or the start of the audio
LEAD_S = 0.36  # lips open this long before voice activity, if known
PART_S, CLOSE_S = 0.15, 0.4  # time to open the mouth slightly, and to close it if the pause lasts
CERTAIN = 0.98  # probability from which the lip predictor closes lips in a pause
_YIELD_S = 0.06  # closing time before a sound, or when the predictor closes the lips
_END_S = 0.25  # closing time after the end of the audio
_RELAX_S = 0.12  # closing time while no audio arrives
_MIN_PAUSE_S = 0.12
_RANGE_DB = 22.0
_FADE_DB = 0.2  # decay of the loudest level per level, so that a bang counts only briefly
_LAST_SOUND_S = 0.03  # silence until this long after lip positions makes their closure doubtful
_LIKELY_BEFORE_S, _LIKELY = 0.15, 0.8  # time before a sound, and the probability that counts then
_DOUBT = 3.0  # log odds
_ONSET_DB = 8.0  # an onset's minimum level above the background
_ONSET_LEAD_S, _ONSET_CLOSE_S = 0.065, 0.05  # lips start to close before an onset; closing time
_ONSET_S = 0.15  # time from the start of this closing for which the goal stays 0
_MIN_BACKGROUND_DB = -75.0  # quieter audio counts as this level
_NUM_FIRST_LEVELS = 3  # their mean is the first background; there is no onset before it
# change of the background per level: fraction of the difference, and during an onset
_BACKGROUND_RATE, _BACKGROUND_RISE_DB = 0.1, 2.0

_AJAR_FAPS = {
    fap: units
    for units, faps in (
        (110.0, [3]),
        (-55.0, [4, 51]),
        (-45.0, [8, 9, 55, 56]),
        (-125.0, [5, 52]),
        (-105.0, [10, 11, 57, 58]),
    )
    for fap in faps
}
AJAR = np.array([_AJAR_FAPS.get(fap, 0.0) for fap in MOUTH_FAPS])  # (num_mouth_faps,) FAP units


class RestingLips:
    """Tracks how far the mouth of one session is ajar."""

    def __init__(self) -> None:
        self._levels: deque[tuple[float, float]] = deque()  # levels of future frames: time s, dB
        # levels more than LEAD_S ahead, which do not count toward the loudest level yet
        self._later_levels: deque[tuple[float, float]] = deque()
        self._speech_changes: deque[SpeechChange] = deque()  # changes in future frames
        self._is_voice = self._has_spoken = self._has_ended = False
        self._is_sounding = False  # whether the level of the last frame is a sound
        self._loudest_db = -math.inf
        self._background_db, self._num_levels = 0.0, 0
        self._onset_until_s = -math.inf  # the last onset closes the lips until this time
        self._known_s = -math.inf  # the levels are known up to here
        self._sound_s = -math.inf  # last sound, start of voice activity or start of the audio
        self._stays_closed = False  # whether the lips stay closed until the next sound
        self._is_closed_by_phone = False  # whether a phone closes the lips
        self._time_s = math.inf  # time of the last frame
        self._goal = 0.0
        self._transition, self._elapsed_s = _transition_to(0.0, 0.0, 0.0, 1.0), 0.0

    def add_event(self, event: SoundEvent) -> None:
        """Add a level, a change of voice activity, or the end of the audio."""
        match event:
            case Progress():
                if self._known_s == -math.inf:
                    self._sound_s = event.time_s
                self._levels.append((event.time_s, event.level_db))
                self._later_levels.append((event.time_s, event.level_db))
                self._known_s = event.time_s
            case SpeechChange():
                self._speech_changes.append(event)
            case EndOfSound():
                self._has_ended = True

    def flush(self) -> None:
        """Drop the known events; the next frames return to rest."""
        self._levels.clear()
        self._later_levels.clear()
        self._speech_changes.clear()
        self._is_voice, self._is_sounding, self._sound_s = False, False, -math.inf

    def process_until(self, time_s: float) -> None:
        """Process the events up to the time of a frame; times increase."""
        while self._speech_changes and self._speech_changes[0].time_s <= time_s:
            change = self._speech_changes.popleft()
            if change.active and not self._is_voice:
                self._sound_s, self._stays_closed = change.time_s, False
            self._is_voice = change.active
            self._has_spoken |= change.active
        while self._later_levels and self._later_levels[0][0] <= time_s + LEAD_S:
            _, level_db = self._later_levels.popleft()
            self._loudest_db = max(level_db, self._loudest_db - _FADE_DB)
        while self._levels and self._levels[0][0] <= time_s:
            level_s, level_db = self._levels.popleft()
            self._update_background(level_db)
            self._is_sounding = self._is_sound(level_db)
            if self._is_sounding:
                self._sound_s, self._stays_closed = level_s, False

    def silence_penalty_at(self, time_s: float, closure: float, phones: float) -> float:
        """Return the log odds that silence subtracts from a closure at the time of lip positions.

        ``closure`` is the predicted probability, and ``phones`` are the log odds that phones add.
        """
        self._is_closed_by_phone = phones > 0.0
        if self._is_closed_by_phone:
            return 0.0
        ends_s, next_s = time_s + _LAST_SOUND_S, self._next_sound_s()
        is_silent = self._is_voice and self._known_s > ends_s and next_s > self._known_s
        is_onset = _YIELD_S < next_s - time_s <= _LIKELY_BEFORE_S
        if closure >= (_LIKELY if is_onset else CERTAIN):
            self._stays_closed |= is_silent or is_onset
            return 0.0
        if self._goal > 0.0:
            return math.inf
        return _DOUBT if is_silent else 0.0

    def amount_at(self, time_s: float) -> float:
        """Return how far the mouth is ajar at the time of a frame, 0 to 1."""
        next_s = self._next_sound_s()
        if self._is_sounding and self._known_s < time_s + _YIELD_S:
            next_s = min(next_s, time_s)  # with a shorter delay, the sound is expected to continue
        soon_s = time_s + LEAD_S
        if self._has_ended:
            self._set_goal(0.0, _END_S)
        elif any(change.active and change.time_s <= soon_s for change in self._speech_changes):
            self._set_goal(1.0, PART_S)
        elif self._is_closed_by_phone or self._stays_closed or next_s <= time_s + _YIELD_S:
            self._set_goal(0.0, _YIELD_S)
        elif self._closes_for_onset(time_s):
            self._set_goal(0.0, _ONSET_CLOSE_S)
        elif time_s > self._sound_s + HOLD_S:
            self._set_goal(0.0, CLOSE_S)
        elif not self._is_voice or min(next_s, self._known_s) >= self._sound_s + _MIN_PAUSE_S:
            self._set_goal(1.0, PART_S)
        self._elapsed_s += max(time_s - self._time_s, 0.0)
        self._time_s = time_s
        return self._amount()

    def relax(self, step_s: float) -> float:
        """Return the amount, one step closer to rest, while media time does not advance."""
        self._set_goal(0.0, _RELAX_S)
        self._elapsed_s += step_s
        return self._amount()

    def _closes_for_onset(self, time_s: float) -> bool:
        """Return whether an onset before the first voice activity closes the lips."""
        if self._has_spoken or self._num_levels < _NUM_FIRST_LEVELS:
            return False
        if time_s > self._onset_until_s:
            onset_db = self._background_db + _ONSET_DB
            end_s = time_s + _ONSET_LEAD_S
            if any(level_s <= end_s and db > onset_db for level_s, db in self._levels):
                self._onset_until_s = time_s + _ONSET_S
        return time_s <= self._onset_until_s

    def _update_background(self, level_db: float) -> None:
        level_db = max(level_db, _MIN_BACKGROUND_DB)
        self._num_levels += 1
        if self._num_levels <= _NUM_FIRST_LEVELS:
            self._background_db += (level_db - self._background_db) / self._num_levels
            return
        difference = level_db - self._background_db
        is_onset = difference > _ONSET_DB
        self._background_db += _BACKGROUND_RISE_DB if is_onset else _BACKGROUND_RATE * difference

    def _is_sound(self, level_db: float) -> bool:
        return self._is_voice and level_db >= self._loudest_db - _RANGE_DB

    def _next_sound_s(self) -> float:
        return next((time_s for time_s, db in self._levels if self._is_sound(db)), math.inf)

    def _set_goal(self, goal: float, duration_s: float) -> None:
        if goal != self._goal:
            velocity = float(self._transition.at(self._elapsed_s).velocity[0])
            self._transition = _transition_to(goal, self._amount(), velocity, duration_s)
            self._goal, self._elapsed_s = goal, 0.0

    def _amount(self) -> float:
        return self._goal + float(self._transition.value_at(self._elapsed_s)[0])


def _transition_to(goal: float, amount: float, velocity: float, duration_s: float) -> Transition:
    difference = FapState(np.array([amount - goal]), np.array([velocity]))
    return Transition(difference, np.array([duration_s]))
