"""Brow, head and eye motion that accompanies speech, in addition to idle motion.

The prosody (:mod:`kouxing.services.synthesizer.modifiers.prosody`) starts all movements:

=================  ==================================================================
prosody            movement
=================  ==================================================================
stressed syllable  a nod; the strongest ones also raise the brows
end of a phrase    a nod
question           the head tilts and the brows rise
start of speech    the head turns, and returns within two seconds
pitch              a high pitch lifts the head
pause              the head holds still
=================  ==================================================================

The gaze leaves the viewer when the speech starts, and returns at its end (Kendon 1967). A face that
listens to someone else looks at the viewer. When the other speaker pauses, it nods and blinks for
0.4 s (Hömke et al. 2018, "Eye blinks are perceived as communicative signals").

Sources: Graf et al. 2002, "Visual prosody" (nods and brows at pitch accents and ends of phrases);
Ambrazaitis et al. 2015 (newsreaders nod on 23 % of the words, and raise the brows on 7 %); Swerts &
Krahmer 2010 (accented words have more nods and brow raises); Munhall et al. 2004 (the head follows
pitch and level); Hadar et al. 1984 (wide head movements when speech starts after a pause). A
two-pole filter smooths each movement. Lips are not moved. The motion depends only on the seed and
the sound.
"""

import math

import numpy as np

from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.services.synthesizer.modifiers.prosody import Prosody, ProsodyTracker
from kouxing.shared.arrays import Floats
from kouxing.shared.face.faps import DEGREE
from kouxing.shared.face.idle_motion import (
    EYES_PITCH,
    EYES_YAW,
    HEAD,
    ConversationState,
    IdleMotion,
    fap_slice,
)
from kouxing.shared.face.smoothing import TwoPoleFilter

_NOD_STRESS, _BROW_STRESS = 2.2, 2.8  # minimum prominence of syllables with these movements
_MAX_EXCESS = 1.2  # difference in prominence of the largest and the weakest nod
_MIN_NOD_INTERVAL_S, _MIN_BROW_INTERVAL_S = 1.0, 2.5
_MIN_SIZE = 0.5  # size of the weakest nod, relative to the largest one
_STARTING_S = 0.9  # duration of speech after a pause
_ENDING_S = 0.2  # silence after which the state is ENDING
_THINKING_S = 0.9  # silence after which it is THINKING
_SILENT_S = 2.5  # silence after which it is SILENT
_NOD_HOLD_S, _BROW_HOLD_S, _TILT_HOLD_S, _TURN_HOLD_S = 0.14, 0.22, 0.6, 0.7
_VISIBLE = 1e-4  # degrees, or brow raises
_FILTER_S, _SLOW_S = 0.08, 0.2  # time constant of each filter pole
_BROW = {  # FAP units of a full movement
    f"raise_{side}_{part}_eyebrow": units
    for part, units in (("i", 45.0), ("m", 55.0), ("o", 35.0))
    for side in "lr"
}
_NOD_DEG = 3.4  # downwards; the filter halves it
_LIFT_DEG = 0.6  # upwards, with a pitch one spread above the mean
_TILT_DEG, _TURN_DEG = 4.0, 2.5
_TURN_S = 0.5  # start times in the same interval of this length have the same direction

_BROWS = fap_slice("raise_l_i_eyebrow", "raise_r_o_eyebrow")
_BROW_UNITS = np.array([*_BROW.values()], np.float32)


class SpeechMotionModifier:
    """Idle motion with movements that accompany speech; seed and sound define the motion."""

    def __init__(self, seed: int) -> None:
        self._idle = IdleMotion(seed)
        self._seed = seed
        self._prosody = ProsodyTracker()
        self._silence_s = math.inf  # silence before the last frame
        self._start_s = -math.inf  # start of the speech
        self._nod_s = self._brow_s = -math.inf  # times of the last movements
        self._is_still = self._is_listening = self._has_heard_pause = False
        self._brow, self._nod = _Movement(_FILTER_S), _Movement(_FILTER_S)
        self._tilt, self._turn = _Movement(_SLOW_S), _Movement(_SLOW_S)
        self._lift = TwoPoleFilter(0.0)

    def set_idle_motion(
        self,
        *,
        still: bool | None = None,
        eye_contact: bool | None = None,
        listening: bool | None = None,
    ) -> None:
        """Set whether head and brows are still, the eyes stay on the viewer, another person speaks.

        None keeps a setting.
        """
        if still is not None:
            self._is_still = self._idle.is_still = still
        if eye_contact is not None:
            self._idle.has_eye_contact = eye_contact
        if listening is not None:
            self._has_heard_pause |= self._is_listening and not listening
            self._is_listening = listening

    def apply(self, faps: Floats, context: FrameContext) -> None:
        """Add the motion to a frame, FAPs (68,), in place."""
        now_s, step_s = context.elapsed_s, context.step_s
        prosody = self._prosody.update(context)
        starts = prosody.silence_s == 0.0 and self._silence_s > _THINKING_S
        self._silence_s = prosody.silence_s
        if starts:
            self._start_s = now_s
        if not self._is_still:
            self._start_movements(prosody, now_s, starts=starts)
        if self._has_heard_pause:
            self._has_heard_pause = False
            self._idle.blink_slowly(now_s)
        self._idle.apply(faps, now_s, self._state(prosody.silence_s, now_s))
        if brow := self._brow.at(now_s, step_s):
            faps[_BROWS] += np.float32(brow) * _BROW_UNITS
        is_voiced = prosody.silence_s < step_s
        is_lifted = is_voiced and not self._is_still
        lift = self._lift.step(prosody.relative_pitch if is_lifted else 0.0, step_s, _SLOW_S)
        lift = lift if abs(lift) > _VISIBLE else 0.0
        pitch = self._nod.at(now_s, step_s) - _LIFT_DEG * lift
        yaw, roll = self._turn.at(now_s, step_s), self._tilt.at(now_s, step_s)
        if pitch or yaw or roll:
            faps[HEAD] += np.array([pitch, yaw, roll], np.float32) * np.float32(DEGREE)
            # the gaze target stays in place
            faps[EYES_PITCH] -= np.float32(pitch * DEGREE)
            faps[EYES_YAW] -= np.float32(yaw * DEGREE)

    def _start_movements(self, prosody: Prosody, now_s: float, *, starts: bool) -> None:
        may_nod = now_s - self._nod_s > _MIN_NOD_INTERVAL_S
        is_accent = prosody.stress > _NOD_STRESS
        if may_nod and (is_accent or prosody.phrase_ended or self._has_heard_pause):
            self._nod_s = now_s
            excess = min(max(prosody.stress - _NOD_STRESS, 0.0) / _MAX_EXCESS, 1.0)
            size = _NOD_DEG * (_MIN_SIZE + (1.0 - _MIN_SIZE) * excess)
            self._nod.start(size, now_s + _NOD_HOLD_S)
        if prosody.stress > _BROW_STRESS and now_s - self._brow_s > _MIN_BROW_INTERVAL_S:
            self._brow_s = now_s
            self._brow.start(1.0, now_s + _BROW_HOLD_S)
        if prosody.is_question:
            self._tilt.start(_TILT_DEG * self._side(now_s), now_s + _TILT_HOLD_S)
            self._brow.start(1.0, now_s + _TILT_HOLD_S)
        if starts:
            self._turn.start(_TURN_DEG * self._side(now_s), now_s + _TURN_HOLD_S)

    def _state(self, silence_s: float, now_s: float) -> ConversationState:
        if silence_s < _ENDING_S:
            is_starting = now_s - self._start_s < _STARTING_S
            return ConversationState.STARTING if is_starting else ConversationState.SPEAKING
        if silence_s < _THINKING_S:
            return ConversationState.ENDING
        if self._is_listening:
            return ConversationState.LISTENING
        return ConversationState.THINKING if silence_s < _SILENT_S else ConversationState.SILENT

    def _side(self, now_s: float) -> float:
        """Return the direction of a movement, 1 or -1; it depends only on seed and time."""
        return float(np.random.default_rng([self._seed, round(now_s / _TURN_S)]).choice([-1, 1]))


class _Movement:
    """A movement to a size and back, with a hold in between."""

    def __init__(self, filter_s: float) -> None:
        self._size, self._until_s = 0.0, -math.inf
        self._filter_s = filter_s
        self._value = TwoPoleFilter(0.0)

    def start(self, size: float, until_s: float) -> None:
        self._size, self._until_s = size, until_s

    def at(self, now_s: float, step_s: float) -> float:
        goal = self._size if now_s < self._until_s else 0.0
        value = self._value.step(goal, step_s, self._filter_s)
        return value if goal or abs(value) > _VISIBLE else 0.0
