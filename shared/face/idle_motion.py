"""Idle motion: blinks, gaze, breathing and small head motion.

Blinks: 17 to 20 per minute in conversation, at log-normal intervals. The lid falls in about 80 ms
and rises half as fast (Bentivoglio et al. 1997; VanderWerf et al. 2003). Gaze: saccades last 21 ms
plus 2.2 ms per degree (Bahill et al. 1975). Speakers look at the listener during most fixations,
but less often while they pause to think (Kendon 1967). Head: turns of about a third of a degree,
slower than 1.5 Hz; larger movements belong to speech. Breath: 14 times a minute, a quarter of a
degree of head motion, with varying intervals and depths (Tobin et al. 1988, "Variability of resting
respiratory drive and timing in healthy subjects"). The eyes compensate head turns
(vestibulo-ocular reflex).

The motion depends only on the seed, the time and recent states. A generator that starts late soon
matches a generator that started with the session.
"""

import math
from collections.abc import Mapping
from enum import Enum

import numpy as np

from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.face.expression_motion import ExpressionMotion
from kouxing.shared.face.faps import DEGREE, FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.smoothing import smooth_step, smoothing_gain

RESTING_RATE_HZ = 25.0
STALL_S = 1.0  # after this time without new frames, a face fades to rest
FADE_S = 0.3


_BLINK_MEDIAN_S = 3.0
_BLINK_LOG_SD = 0.5
_BLINK_MIN_S = 0.6
_LID_FALL_S, _LID_CLOSED_S, _LID_RISE_S = 0.08, 0.03, 0.16
_BLINK_S = _LID_FALL_S + _LID_CLOSED_S + _LID_RISE_S
_SLOW_BLINK = 1.6  # duration of a slow blink, in multiples of _BLINK_S
UPPER_LID, LOWER_LID = 900.0, 150.0  # the sum slightly exceeds the open eye's 1024

_FIXATION_MEAN_S = 1.4
_FIXATION_MIN_S = 0.3
_REACTION_S = 0.15  # the gaze follows a new state after this time
_GAZE_SD_DEG = (0.5, 0.4)  # fixations on the listener: horizontal, vertical
_GLANCE_SD_DEG = (5.0, 2.5)  # other fixations
_GLANCE_LIMIT_DEG = 12.0
_LID_PER_GAZE = 0.012  # FAP units of the upper lid per unit of downward gaze

_HEAD_SD_DEG = (0.32, 0.38, 0.21)  # pitch, yaw, roll
_HEAD_HZ = (0.07, 1.4)
_NUM_WAVES = 24  # with fewer, the motion nearly repeats within a minute
_STATE_S = 0.8  # time constant of a change of the head's motion
_BREATH_HZ, _BREATH_SD_DEG = (0.18, 0.28), 0.2


def fap_slice(first: str, last: str) -> slice:
    """Return the slice of consecutive FAPs in an array (68,)."""
    return slice(FAP_NUMBER[first] - 1, FAP_NUMBER[last])


_LIDS_UPPER = fap_slice("close_t_l_eyelid", "close_t_r_eyelid")
_LIDS_LOWER = fap_slice("close_b_l_eyelid", "close_b_r_eyelid")
EYES_YAW = fap_slice("yaw_l_eyeball", "yaw_r_eyeball")
EYES_PITCH = fap_slice("pitch_l_eyeball", "pitch_r_eyeball")
HEAD = fap_slice("head_pitch", "head_roll")

IDLE_MOTION_SEED = 3


class ConversationState(Enum):
    """Conversational state, which controls gaze and head motion."""

    SILENT = "silent"  # nobody speaks
    LISTENING = "listening"  # another person speaks
    STARTING = "starting"  # the first second of the session's speech
    SPEAKING = "speaking"
    ENDING = "ending"  # the first moment after the session's speech
    THINKING = "thinking"  # a pause within the session's speech


_PAUSES = (ConversationState.ENDING, ConversationState.THINKING)
_LIVELINESS_IN_PAUSES = 0.3  # factor for the head in pauses
# fraction of the fixations on the listener
_ON_LISTENER = {
    ConversationState.SILENT: 0.8,
    ConversationState.LISTENING: 0.95,
    ConversationState.STARTING: 0.3,
    ConversationState.SPEAKING: 0.88,
    ConversationState.ENDING: 1.0,
    ConversationState.THINKING: 0.5,
}


class IdleMotion:
    """Motion of eyes and head; the same seed gives the same motion. Times must not decrease."""

    def __init__(self, seed: int = IDLE_MOTION_SEED) -> None:
        self.is_still = False  # whether the head holds still
        self.has_eye_contact = False  # whether the eyes stay on the viewer
        self._seed = seed
        waves, self._blink_rng, self._fixation_rng = (
            np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3)
        )
        # breath and pink-like noise as sums of sines: pure functions of time
        low_hz, high_hz = np.array([_BREATH_HZ, _HEAD_HZ, _HEAD_HZ, _HEAD_HZ]).T
        wave_hz = np.geomspace(low_hz, high_hz, _NUM_WAVES, axis=1)
        wave_hz *= waves.uniform(0.95, 1.05, wave_hz.shape)
        self._wave_rate = 2.0 * np.pi * wave_hz  # radians per second
        self._wave_phase = waves.uniform(0.0, 2.0 * np.pi, wave_hz.shape)
        size = wave_hz**-0.5
        size *= np.sqrt(2.0 / np.sum(size**2, axis=1, keepdims=True))
        self._wave_size = size * np.array([_BREATH_SD_DEG, *_HEAD_SD_DEG])[:, None] * DEGREE
        self._liveliness = 1.0
        self._time_s = 0.0
        self._state = ConversationState.SILENT
        self._blink_s = self._draw_blink(0.0)
        self._blink_slowness = 1.0  # relative to the usual duration
        self._gaze_from = self._gaze_to = np.zeros(2)
        self._saccade_s, self._saccade_length_s = 0.0, 0.03
        self._fixation = 0  # its number
        self._fixation_end_s = self._draw_fixation(0.0)
        self._reaction_s = math.inf  # when the gaze follows a new state

    def apply(
        self, faps: Floats, time_s: float, state: ConversationState = ConversationState.SILENT
    ) -> None:
        """Add the motion, at a time since the first frame, to FAPs (68,) in place."""
        if state is not self._state:
            self._state = state
            self._reaction_s = min(self._reaction_s, time_s + _REACTION_S)
        elapsed_s = max(time_s - self._time_s, 0.0)
        self._time_s = time_s
        goal = _LIVELINESS_IN_PAUSES if state in _PAUSES else 1.0
        change = (0.0 if self.is_still else goal) - self._liveliness
        self._liveliness += change * smoothing_gain(elapsed_s, _STATE_S)
        angles = self._wave_rate * time_s + self._wave_phase
        breath, *sway = (self._wave_size * np.sin(angles)).sum(axis=1)
        head = self._liveliness * np.array(sway)
        head[0] += breath
        yaw, pitch = self._gaze(time_s)
        lid = self._lid(time_s)
        faps[HEAD] += head.astype(np.float32)
        # the gaze target stays in place while the head turns
        faps[EYES_PITCH] += pitch - head[0]
        faps[EYES_YAW] += yaw - head[1]
        faps[_LIDS_UPPER] += _LID_PER_GAZE * (pitch - head[0])
        if lid:  # start from the lid position that an expression has set
            faps[_LIDS_UPPER] += lid * (UPPER_LID - faps[_LIDS_UPPER])
            faps[_LIDS_LOWER] += lid * (LOWER_LID - faps[_LIDS_LOWER])

    def blink_slowly(self, time_s: float) -> None:
        """Start a slow blink, unless the lids are moving."""
        if time_s < self._blink_s:
            self._blink_s, self._blink_slowness = time_s, _SLOW_BLINK

    def _draw_blink(self, after_s: float) -> float:
        interval_s = _BLINK_MEDIAN_S * math.exp(_BLINK_LOG_SD * self._blink_rng.standard_normal())
        return after_s + max(interval_s, _BLINK_MIN_S)

    def _draw_fixation(self, after_s: float) -> float:
        return after_s + _FIXATION_MIN_S + float(self._fixation_rng.exponential(_FIXATION_MEAN_S))

    def _lid(self, time_s: float) -> float:
        """Return how far the lids are closed, 0 to 1."""
        while time_s > self._blink_s + self._blink_slowness * _BLINK_S:
            self._blink_s, self._blink_slowness = self._draw_blink(self._blink_s), 1.0
        since_s = (time_s - self._blink_s) / self._blink_slowness
        if since_s < _LID_FALL_S + _LID_CLOSED_S:
            return smooth_step(since_s / _LID_FALL_S)
        return 1.0 - smooth_step((since_s - _LID_FALL_S - _LID_CLOSED_S) / _LID_RISE_S)

    def _gaze(self, time_s: float) -> Doubles:
        """Return yaw (left) and pitch (down) of the gaze in space."""
        if time_s >= min(self._fixation_end_s, self._reaction_s):
            saccade_s = self._reaction_s
            while time_s >= self._fixation_end_s:
                saccade_s, self._fixation = self._fixation_end_s, self._fixation + 1
                self._fixation_end_s = self._draw_fixation(saccade_s)
            self._reaction_s = math.inf
            self._look_at(self._target(), saccade_s)
        return self._gaze_at(time_s)

    def _gaze_at(self, time_s: float) -> Doubles:
        done = smooth_step((time_s - self._saccade_s) / self._saccade_length_s)
        return self._gaze_from + done * (self._gaze_to - self._gaze_from)

    def _look_at(self, target: Doubles, saccade_s: float) -> None:
        if np.array_equal(target, self._gaze_to):
            return
        self._gaze_from, self._gaze_to = self._gaze_at(saccade_s), target
        size_deg = float(np.linalg.norm(target - self._gaze_from)) / DEGREE
        self._saccade_s, self._saccade_length_s = saccade_s, 0.021 + 0.0022 * size_deg

    def _target(self) -> Doubles:
        """Return the target of the current fixation in the current state."""
        rng = np.random.default_rng([self._seed, self._fixation])
        probability = 1.0 if self.has_eye_contact else _ON_LISTENER[self._state]
        is_on_listener = rng.random() < probability
        sd = _GAZE_SD_DEG if is_on_listener else _GLANCE_SD_DEG
        return np.clip(rng.normal(0.0, sd), -_GLANCE_LIMIT_DEG, _GLANCE_LIMIT_DEG) * DEGREE


class RestingFace:
    """The face without a session: shows expressions and, optionally, idle motion."""

    def __init__(self, *, idle_motion: bool) -> None:
        self._motion = IdleMotion() if idle_motion else None
        self._expression = ExpressionMotion()
        self._start_s: float | None = None
        self._last_s = 0.0

    def express(self, strengths: Mapping[str, float], hold_s: float) -> None:
        """Show expressions, strengths 0 to 1 by name, for a time; they replace earlier ones."""
        self._expression.show(strengths, hold_s)

    def faps(self, now_s: float) -> Floats:
        """Return the FAPs (68,) at a time of any clock; times must not decrease."""
        if self._start_s is None:
            self._start_s = self._last_s = now_s
        faps = np.zeros(NUM_FAPS, np.float32)
        self._expression.add(faps, now_s - self._last_s, is_speaking=False)
        self._last_s = now_s
        if self._motion is not None:
            self._motion.apply(faps, now_s - self._start_s)
        return faps

    def blend(self, face: Floats, weight: float, now_s: float) -> Floats:
        """Blend another face with the resting face; return FAPs (68,). 1 is the other face."""
        rest = self.faps(now_s)
        return rest + np.float32(weight) * (face - rest)
