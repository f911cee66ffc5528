"""Animates the face of one session, without sockets: turns sound events into FAP frames.

    events -> lip model -> modifiers -> frames

Frames follow media time, so they do not depend on the arrival times of events. The caller
decides when a stream has stalled and requests frames that return to rest (`FaceAnimator.relax`).

The face moves continuously when another recognizer takes over (`change_recognizer`), when this face
replaces the face of another process (`resume`), and when the lip model changes (`set_lip_model`). A
*transition* of all FAPs then fades the difference between old and new frames to zero. Lips that
must close for speech also close during the transition.
"""

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.lip_model import LipModel, MouthFrame
from kouxing.services.synthesizer.lips.trajectory import FapState, Transition
from kouxing.services.synthesizer.modifiers.amplitude import AmplitudeModifier
from kouxing.services.synthesizer.modifiers.expressiveness import ExpressivenessModifier
from kouxing.services.synthesizer.modifiers.feeling import FeelingModifier
from kouxing.services.synthesizer.modifiers.modifier import FrameContext, Modifier
from kouxing.services.synthesizer.modifiers.nonverbal import ExpressionModifier, NonverbalModifier
from kouxing.services.synthesizer.modifiers.speech_motion import SpeechMotionModifier
from kouxing.services.synthesizer.phone_renumberer import PhoneRenumberer
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.clock import MAX_GAP_S
from kouxing.shared.face.expression_motion import JAW, mix_expression
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.face.idle_motion import IDLE_MOTION_SEED
from kouxing.shared.phones.events import (
    AudioSkipped,
    EndOfSound,
    Phone,
    Progress,
    SoundEvent,
    SpeechChange,
    time_of,
)

Faps: TypeAlias = Doubles  # (68,)
Frame: TypeAlias = tuple[float, Floats]  # media time in seconds; FAPs (68,)

MAX_DELAY_S = 1.5  # at most 0.3 live; a viseme further ahead has no visible weight
REST_S = 0.3  # duration of the return to rest after the end of the sound
_RECENT_S = 2.0  # events that a new lip model receives
_WARM_UP_FRAMES = 10  # frames of a new lip model before it is shown
# When a face resumes, this much of the past is computed again without being shown. Its first frame
# receives all earlier audio levels at once. Any brow or head motion that they trigger must end
# before frames are shown.
_REHEARSAL_S = 1.6
_MOUTH_TRANSITION_S, _TRANSITION_S = 0.14, 0.6  # durations for mouth FAPs and for other FAPs
_CLOSE_LIPS_AFTER_S = 0.04  # from this time of a transition, lips close fully for speech
_VOICE_LEAD_S = 0.06  # feeling and laughter act this much earlier, if known
_SPEECH_LEAD_S = 0.04  # speech that starts within this time counts as started
_ROUNDING = 0.01  # tolerance of media times, in frames

_MOUTH = np.array(MOUTH_FAPS) - 1
_TRANSITIONS_S = np.full(NUM_FAPS, _TRANSITION_S)
_TRANSITIONS_S[_MOUTH] = _MOUTH_TRANSITION_S
_ZERO = np.zeros(NUM_FAPS)
_NO_TRANSITION = Transition(FapState(_ZERO, _ZERO), _TRANSITIONS_S)


class FaceAnimator:
    """Turns the sound events of a session, in order, into FAP frames.

    Frame ``k`` is at media time ``k / frame_rate_hz``, with a rate of 10 to 240. It is made
    ``delay_s`` (0 to 1.5) later than its audio; at 1.5 the visemes of a recording are blended as if
    all were known. ``idle_motion`` adds blinks, gaze, brow and head motion, which
    ``idle_motion_seed`` determines; without it, only the mouth moves. ``expressiveness`` scales the
    mouth movements, 0.5 to 2. ``feeling`` is how strongly the face shows the feeling in the voice,
    0 to 1.
    """

    def __init__(
        self,
        lip_model: LipModel,
        *,
        frame_rate_hz: float,
        delay_s: float,
        idle_motion: bool = False,
        idle_motion_seed: int = IDLE_MOTION_SEED,
        expressiveness: float = 1.0,
        feeling: float = 0.0,
    ) -> None:
        self._lip_model = lip_model
        self._frame_rate_hz = frame_rate_hz
        self._delay_s = delay_s
        self._expressiveness = ExpressivenessModifier(expressiveness)
        self._expression = ExpressionModifier()
        self._feeling = FeelingModifier(feeling)
        self._idle_motion = SpeechMotionModifier(idle_motion_seed) if idle_motion else None
        self._num_frames = 0  # including frames at rest
        self._first_shown = 0  # earlier frames are rehearsals
        self._target: Faps | None = None  # the last frame without its transition
        self._shown: Faps | None = None  # the last shown frame
        self._previously_shown: Faps = _ZERO  # the shown frame before that
        self._is_resuming = False  # whether the next shown frame starts a transition from the last
        self._transition, self._transition_s = _NO_TRANSITION, 0.0  # current transition; its age
        self._event_s = 0.0  # time of the last event
        self._start_at(0)

    def _start_at(self, number: int) -> None:
        """Start at rest, at a frame number."""
        self._next_frame = number
        self._time_s = number / self._frame_rate_hz  # time of the last frame
        self._known_s = -math.inf  # the sound is known up to here
        self._phones = PhoneRenumberer()
        self._is_speaking = False  # whether there was speech at the last frame
        self._speech_changes: deque[SpeechChange] = deque()  # changes in future frames
        self._levels: list[tuple[float, float]] = []  # since the last frame
        self._pitches: list[tuple[float, float]] = []  # since the last frame
        self._progress: deque[Progress] = deque()  # current and later progress
        self._recent: deque[SoundEvent] = deque()
        self._lip_stream = self._lip_model.stream(
            self._time_s, frame_rate_hz=self._frame_rate_hz, delay_s=self._delay_s
        )
        # in order of application
        self._modifiers: list[Modifier] = [
            AmplitudeModifier(),
            self._expressiveness,
            self._feeling,
            self._expression,
            NonverbalModifier(),
        ]
        if self._idle_motion is not None:
            self._modifiers.append(self._idle_motion)

    def process(self, event: SoundEvent) -> list[Frame]:
        """Process an event; return the frames that are now due.

        After a gap of more than ``MAX_GAP_S``, the face restarts. At the end of the sound, all
        remaining frames are returned, with the return to rest.
        """
        return list(self.iter_frames(event))

    def iter_frames(self, event: SoundEvent) -> Iterator[Frame]:
        """Yield the frames of ``process`` one by one; exhaust this before the next event."""
        time_s = time_of(event)
        if time_s - self._event_s > MAX_GAP_S and not isinstance(event, AudioSkipped):
            self._start_at(self._frame_number(max(0.0, time_s - self._delay_s)))
        self._event_s = max(self._event_s, time_s)
        if isinstance(event, AudioSkipped):
            self.skip_to(time_s)
            return
        if isinstance(event, EndOfSound):
            self._add_event(SpeechChange(active=False, time_s=time_s))
            self._pass_to_lips(event)
            yield from self._frames_until(time_s + self._delay_s + REST_S)
            return
        self._add_event(event)
        if isinstance(event, Progress):
            yield from self._frames_until(time_s)

    def skip_to(self, time_s: float) -> None:
        """Skip the frames before a media time. The face moves there smoothly."""
        self._event_s = max(self._event_s, time_s)
        number = self._frame_number(time_s - self._delay_s)
        if number > self._next_frame:
            self._next_frame = number
            self._target, self._is_resuming = None, True

    def change_recognizer(self) -> None:
        """Continue with the events of another recognizer; discard phones that are not final.

        The new recognizer numbers phones from 0 and may repeat known events.
        """
        self._phones.restart()

    def resume(self, time_s: float, num_frames: int, shown: Floats | None = None) -> None:
        """Replace the face of another process, before this face has made any frames.

        Events of the last seconds may be repeated. Their last frames are rehearsed, not shown.
        ``time_s`` is the media time of the other face's newest frame, ``num_frames`` is the number
        of its frames, and ``shown`` is the newest frame, FAPs (68,), if known.
        """
        self._first_shown = self._frame_number(time_s) + 1
        num_rehearsed = min(
            num_frames, self._first_shown, round(_REHEARSAL_S * self._frame_rate_hz)
        )
        self._num_frames = num_frames - num_rehearsed
        self._event_s = time_s
        self._start_at(self._first_shown - num_rehearsed)
        self._is_resuming = shown is not None
        self._shown = None if shown is None else shown.astype(np.float64)

    def relax(self, num_frames: int) -> list[Frame]:
        """Make frames that return to rest while no sound arrives.

        They all have the media time of the last frame. The face continues from its pose when sound
        arrives again.
        """
        step_s = 1.0 / self._frame_rate_hz
        self._update_speaking(math.inf)
        self._progress.clear()
        self._withdraw_phones()
        return [self._make_frame(self._lip_stream.relax(step_s)) for _ in range(num_frames)]

    def flush(self) -> None:
        """Drop the known events (an interruption); the next frames return to rest."""
        self._recent.clear()
        self._lip_stream.flush()

    def set_expressions(self, strengths: Mapping[str, float], hold_s: float) -> None:
        """Show expressions, strengths 0 to 1 by name, for a time; they replace earlier ones."""
        self._expression.show(strengths, hold_s)

    def set_expressiveness(self, amount: float) -> None:
        """Set the size of mouth movements, 0.5 to 2; 1 leaves the lip model unchanged."""
        self._expressiveness.amount = amount

    def set_feeling(self, amount: float) -> None:
        """Set how strongly the face shows the feeling in the voice, 0 to 1."""
        self._feeling.amount = amount

    def set_idle_motion(self, **settings: bool | None) -> None:
        """Change the idle motion, if any, as ``SpeechMotionModifier.set_idle_motion``."""
        if self._idle_motion is not None:
            self._idle_motion.set_idle_motion(**settings)

    def set_lip_model(self, lip_model: LipModel) -> None:
        """Change the lip model with a continuous transition."""
        if lip_model is self._lip_model:
            return
        step_s = 1.0 / self._frame_rate_hz
        start_s = self._time_s - _WARM_UP_FRAMES * step_s
        stream = lip_model.stream(start_s, frame_rate_hz=self._frame_rate_hz, delay_s=self._delay_s)
        for event in self._recent:
            stream.add_event(event)
        mouths = [
            stream.frame_at(start_s + number * step_s) for number in range(1, _WARM_UP_FRAMES + 1)
        ]
        self._lip_model, self._lip_stream = lip_model, stream
        if self._shown is None or self._is_resuming:
            return
        before, self._target = (
            self._pose(mouth, step_s=0.0, levels=(), pitches=()).astype(np.float64)
            for mouth in mouths[-2:]
        )
        steps = (self._shown - self._previously_shown) - (self._target - before)
        velocity = np.zeros(NUM_FAPS)  # FAPs outside the mouth move as before
        velocity[_MOUTH] = steps[_MOUTH] / step_s
        self._start_transition(FapState(self._shown - self._target, velocity))

    def _start_transition(self, difference: FapState) -> None:
        """Add a difference that fades to zero to the next frames."""
        self._transition, self._transition_s = Transition(difference, _TRANSITIONS_S), 0.0

    def _add_event(self, event: SoundEvent) -> None:
        if isinstance(event, Progress):
            if event.time_s <= self._known_s:  # repeated by another recognizer
                return
            self._known_s = event.time_s
        elif isinstance(event, Phone):
            event = self._phones.renumber(event)
        self._pass_to_lips(event)
        if isinstance(event, SpeechChange):
            self._speech_changes.append(event)
        elif isinstance(event, Progress):
            if math.isfinite(event.level_db):
                self._levels.append((event.time_s, event.level_db))
            self._progress.append(event)
            if event.pitch_hz > 0.0:
                self._pitches.append((event.time_s, event.pitch_hz))

    def _pass_to_lips(self, event: SoundEvent) -> None:
        self._lip_stream.add_event(event)
        self._recent.append(event)
        while self._recent and time_of(self._recent[0]) < self._event_s - _RECENT_S:
            self._recent.popleft()

    def _withdraw_phones(self) -> None:
        """Withdraw the phones of a lost recognizer that the new one has not confirmed."""
        for phone in self._phones.take_withdrawn():
            self._pass_to_lips(phone)

    def _frame_number(self, time_s: float) -> int:
        """Return the number of the frame at or after a media time."""
        return math.ceil(time_s * self._frame_rate_hz - _ROUNDING)

    def _frames_until(self, time_s: float) -> Iterator[Frame]:
        """Yield new frames that are due when the sound is known up to ``time_s``."""
        last = math.floor((time_s - self._delay_s) * self._frame_rate_hz + _ROUNDING)
        if last >= self._next_frame:
            self._withdraw_phones()
        while self._next_frame <= last:
            number = self._next_frame
            self._next_frame += 1
            self._time_s = number / self._frame_rate_hz
            self._update_speaking(self._time_s)
            mouth = self._lip_stream.frame_at(self._time_s)
            if number >= self._first_shown:
                yield self._make_frame(mouth)
            else:
                self._make_target(mouth)

    def _update_speaking(self, time_s: float) -> None:
        while self._speech_changes and self._speech_changes[0].time_s <= time_s:
            change = self._speech_changes.popleft()
            self._is_speaking = change.active
            if change.active:  # levels before speech are noise
                self._levels = [level for level in self._levels if level[0] >= change.time_s]

    def _make_frame(self, mouth: MouthFrame) -> Frame:
        rehearsed = self._target
        faps = self._make_target(mouth)
        if self._is_resuming and self._shown is not None:
            self._is_resuming = False
            goal = faps if rehearsed is None else rehearsed
            self._start_transition(FapState(self._shown - goal, _ZERO))
        self._transition_s += 1.0 / self._frame_rate_hz
        if self._transition_s < self._transition.longest_s:
            self._add_difference(faps, self._transition.value_at(self._transition_s))
        shown = faps.astype(np.float64)
        self._previously_shown = shown if self._shown is None else self._shown
        self._shown = shown
        return self._time_s, faps

    def _add_difference(self, faps: Floats, difference: Faps) -> None:
        """Add the remaining difference of a transition to a frame, in place."""
        if difference.any():
            lip_weight = max(
                self._expression.lip_weight, 1.0 - self._transition_s / _CLOSE_LIPS_AFTER_S
            )
            jaw = faps[JAW] + difference[JAW]  # the jaw does not open the lips
            mix_expression(faps, difference.astype(np.float32), lip_weight)
            faps[JAW] = max(jaw, 0.0)

    def _make_target(self, mouth: MouthFrame) -> Floats:
        """Make the next frame without the transition, FAPs (68,)."""
        levels, self._levels = self._levels, []
        pitches, self._pitches = self._pitches, []
        self._num_frames += 1
        step_s = 1.0 / self._frame_rate_hz
        faps = self._pose(mouth, step_s=step_s, levels=levels, pitches=pitches)
        self._target = faps.astype(np.float64)
        return faps

    def _pose(
        self,
        mouth: MouthFrame,
        *,
        step_s: float,
        levels: Sequence[tuple[float, float]],
        pitches: Sequence[tuple[float, float]],
    ) -> Floats:
        """Apply all modifiers to a mouth; return FAPs (68,). A step of 0 is a dry run."""
        faps = np.zeros(NUM_FAPS, dtype=np.float32)
        faps[_MOUTH] = mouth.faps
        soon_s = self._time_s + _SPEECH_LEAD_S
        starts_soon = any(
            change.active and change.time_s <= soon_s for change in self._speech_changes
        )
        until_s = self._time_s + _VOICE_LEAD_S
        while len(self._progress) > 1 and self._progress[1].time_s <= until_s:
            self._progress.popleft()
        voice = self._progress[0] if self._progress else None
        context = FrameContext(
            time_s=self._time_s,
            known_s=self._time_s + self._delay_s,
            elapsed_s=(self._num_frames - 1) / self._frame_rate_hz,
            step_s=step_s,
            is_speaking=self._is_speaking or starts_soon,
            levels=levels,
            pitches=pitches,
            articulation=mouth.articulation,
            feeling=(voice.arousal, voice.valence) if voice else (0.0, 0.0),
            is_laughter=voice is not None and voice.is_laughter,
            is_breath=voice is not None and voice.is_breath,
            amplitude_applies=self._lip_model.amplitude_applies,
        )
        for modifier in self._modifiers:
            modifier.apply(faps, context)
        return faps


def configured_face(
    lip_model: LipModel, config: SynthesizerConfig, *, delay_s: float | None = None
) -> FaceAnimator:
    """Return a face with the settings of a configuration; ``delay_s`` replaces its delay."""
    return FaceAnimator(
        lip_model,
        frame_rate_hz=config.frame_rate_hz,
        delay_s=config.delay_ms / 1e3 if delay_s is None else delay_s,
        idle_motion=config.idle_motion,
        expressiveness=config.expressiveness,
        feeling=config.feeling,
    )
