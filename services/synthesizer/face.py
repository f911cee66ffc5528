"""One session's face, without sockets: sound events in, FAP frames out.

    events -> lip model -> modifiers -> frames

Frames are clocked by media time, so they do not depend on when the events arrive. The caller
decides when a stream has stalled and asks for frames that lead to rest (`Face.relax`).

The face goes on without a jump when its sound comes from another recognizer (`Face.restart`), when
it takes another face's place (`Face.resume`), and when another lip model moves its mouth
(`Face.use_lips`). What was shown then differs from what is shown next: a *transition* of all FAPs
leads the difference to zero. Lips that are to be shut for speech shut in spite of it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.trajectory import Motion, Transition
from kouxing.services.synthesizer.lips.lip_model import LipModel, MouthFrame
from kouxing.services.synthesizer.modifiers.amplitude import Amplitude
from kouxing.services.synthesizer.modifiers.expression import Expression, mix
from kouxing.services.synthesizer.modifiers.expressiveness import JAW, Expressiveness
from kouxing.services.synthesizer.modifiers.life import Life
from kouxing.services.synthesizer.modifiers.modifier import Modifier, Moment
from kouxing.services.synthesizer.phone_numbers import PhoneNumbers
from kouxing.shared.clock import MAX_GAP_S
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.events import EndOfSound, Phone, Progress, SoundEvent, SpeechChange

Faps: TypeAlias = NDArray[np.float64]  # (68,)
Frame: TypeAlias = tuple[float, NDArray[np.float32]]  # media time in seconds, FAPs (68,)

MAX_DELAY_S = 1.5  # live at most 0.3; further ahead a viseme weighs less than a face can show
REST_S = 0.3  # frames that lead to rest after the end of the sound
_RECENT_S = 2.0  # of events that a new lip model is told
_CATCH_UP_FRAMES = 10  # that it makes before it is seen
_REHEARSED_S = 0.8  # of frames that a face makes unseen before it takes another's place
_MOUTH_CHANGE_S, _CHANGE_S = 0.14, 0.6  # in which a difference of the mouth fades, and another
_BIND_S = 0.04  # from which on lips shut for speech in spite of it
_SPEECH_LEAD_S = 0.04  # speech that begins within this, if known, counts as begun
_ROUNDING = 0.01  # of media time, in frames, that is forgiven

_MOUTH = np.array(MOUTH_FAPS) - 1
_CHANGES_S = np.full(NUM_FAPS, _CHANGE_S)
_CHANGES_S[_MOUTH] = _MOUTH_CHANGE_S
_NOTHING = np.zeros(NUM_FAPS)
_NO_DIFFERENCE = Transition(Motion(_NOTHING, _NOTHING), _CHANGES_S)


class Face:
    """Turns the sound events of a session, in order, into FAP frames.

    Parameters
    ----------
    lips
        The lip model.
    frame_rate_hz
        10 to 240; frame ``k`` is at media time ``k / frame_rate_hz``.
    delay_s
        0 to 1.5: how much later than its sound a frame is made; with 1.5 a recording's visemes are
        blended as if all were known.
    idle_motion_seed
        Seed of blinks, gaze, brows and head motion; with 0 the mouth alone moves.
    expressiveness
        0.5 to 2: how large the mouth's movements are; 1 for those of the lip model.

    Raises
    ------
    UserError
        If a value is out of range.
    """

    def __init__(
        self,
        lips: LipModel,
        *,
        frame_rate_hz: float,
        delay_s: float,
        idle_motion_seed: int = 0,
        expressiveness: float = 1.0,
    ) -> None:
        if not 0.0 <= delay_s <= MAX_DELAY_S:
            raise UserError(f"delay_s is {delay_s:g}; give 0 to {MAX_DELAY_S:g} seconds")
        if not 10.0 <= frame_rate_hz <= 240.0:
            raise UserError(f"frame_rate_hz is {frame_rate_hz:g}; give 10 to 240")
        self._lip_model = lips
        self._frame_rate_hz = frame_rate_hz
        self._delay_s = delay_s
        self._expressiveness = Expressiveness(expressiveness)
        self._expression = Expression()
        self._life = Life(idle_motion_seed) if idle_motion_seed else None
        self._num_frames = 0  # made so far, while media time stood still too
        self._first_seen = 0  # frames before it are rehearsed
        self._own: Faps | None = None  # of the last frame, without what is left of a difference
        self._shown: Faps | None = None  # of the last frame that was seen
        self._shown_before: Faps = _NOTHING  # of the one before
        self._is_resuming = False  # nothing was seen yet of this face, but of the one before
        self._difference, self._difference_s = _NO_DIFFERENCE, 0.0  # to what was shown; its age
        self._event_s = 0.0  # of the last event
        self._begin(0)

    def _begin(self, number: int) -> None:
        """Begin at rest with a frame."""
        self._next_frame = number
        self._time_s = number / self._frame_rate_hz  # of the last frame
        self._known_s = -math.inf  # the sound is known up to here
        self._phones = PhoneNumbers()
        self._is_speaking = False  # at the last frame
        self._changes: deque[SpeechChange] = deque()  # of frames to come
        self._levels: list[tuple[float, float]] = []  # since the last frame
        self._pitches: list[tuple[float, float]] = []  # since the last frame
        self._recent: deque[SoundEvent] = deque()  # those a new lip model is told
        self._lips = self._lip_model.stream(
            self._time_s, frame_rate_hz=self._frame_rate_hz, delay_s=self._delay_s
        )
        self._modifiers: list[Modifier] = [  # applied in this order
            Amplitude(),
            self._expressiveness,
            self._expression,
        ]
        if self._life is not None:
            self._modifiers.append(self._life)

    def accept(self, event: SoundEvent) -> list[Frame]:
        """Take an event; return the frames that are due then.

        After a gap of more than ``MAX_GAP_S`` the face starts again behind it. The end of the sound
        brings the frames still owed and those that lead to rest.
        """
        return list(self.frames_of(event))

    def frames_of(self, event: SoundEvent) -> Iterator[Frame]:
        """Yield what ``accept`` returns: take all before the next event, but when you like."""
        time_s = _time_of(event)
        if time_s - self._event_s > MAX_GAP_S:
            self._begin(self._number_at(max(0.0, time_s - self._delay_s)))
        self._event_s = time_s
        if isinstance(event, EndOfSound):
            self._accept(SpeechChange(active=False, time_s=time_s))
            yield from self._frames_until(time_s + self._delay_s + REST_S)
            return
        self._accept(event)
        if isinstance(event, Progress):
            yield from self._frames_until(time_s)

    def restart(self) -> None:
        """Go on with another recognizer's events; phones that were not final are void.

        It counts phones anew, and may tell again what is known already.
        """
        self._phones.restart()

    def resume(self, time_s: float, frame: int, shown: NDArray[np.float32] | None = None) -> None:
        """Take the place of another face that has made some frames; this one has made none.

        The events of the seconds before may come again. Their last frames are rehearsed unseen.

        Parameters
        ----------
        time_s
            Media time of its newest frame.
        frame
            How many frames it has made.
        shown
            FAPs (68,) of the newest; None: unknown.
        """
        self._first_seen = self._number_at(time_s) + 1
        num_rehearsed = min(frame, self._first_seen, round(_REHEARSED_S * self._frame_rate_hz))
        self._num_frames = frame - num_rehearsed
        self._event_s = time_s
        self._begin(self._first_seen - num_rehearsed)
        self._is_resuming = shown is not None
        self._shown = None if shown is None else shown.astype(np.float64)

    def relax(self, num_frames: int) -> list[Frame]:
        """Return frames that lead to rest while no sound comes.

        All carry the media time of the last frame. When sound comes again, the face goes on from
        where it is then.
        """
        step_s = 1.0 / self._frame_rate_hz
        self._follow_speech(math.inf)
        self._withdraw()
        return [self._frame(self._lips.relax(step_s)) for _ in range(num_frames)]

    def flush(self) -> None:
        """Drop what is known (an interruption); the frames to come lead to rest."""
        self._recent.clear()
        self._lips.flush()

    def express(self, strengths: Mapping[str, float], hold_s: float) -> None:
        """Show expressions, strengths 0 to 1 by name, for a time; in place of those before."""
        self._expression.show(strengths, hold_s)

    def choose_expressiveness(self, amount: float) -> None:
        """Let the mouth move more or less from here on: 0.5 to 2, 1 as the lip model moves it."""
        self._expressiveness.amount = amount

    def use_lips(self, lips: LipModel) -> None:
        """Let another lip model move the mouth, without a jump from where it is."""
        if lips is self._lip_model:
            return
        step_s = 1.0 / self._frame_rate_hz
        begin_s = self._time_s - _CATCH_UP_FRAMES * step_s
        stream = lips.stream(begin_s, frame_rate_hz=self._frame_rate_hz, delay_s=self._delay_s)
        for event in self._recent:
            stream.accept(event)
        mouths = [
            stream.frame_at(begin_s + number * step_s) for number in range(1, _CATCH_UP_FRAMES + 1)
        ]
        self._lip_model, self._lips = lips, stream
        if self._shown is None or self._is_resuming:
            return
        before, self._own = (self._pose(mouth).astype(np.float64) for mouth in mouths[-2:])
        steps = (self._shown - self._shown_before) - (self._own - before)
        slope = np.zeros(NUM_FAPS)  # all but the mouth moves as before
        slope[_MOUTH] = steps[_MOUTH] / step_s
        self._lead(Motion(self._shown - self._own, slope))

    def _lead(self, difference: Motion) -> None:
        """Let the next frames differ from what they would be, less and less."""
        self._difference, self._difference_s = Transition(difference, _CHANGES_S), 0.0

    def _accept(self, event: SoundEvent) -> None:
        if isinstance(event, Progress):
            if event.time_s <= self._known_s:  # from another recognizer once more
                return
            self._known_s = event.time_s
        elif isinstance(event, Phone):
            event = self._phones.place(event)
        self._tell_lips(event)
        if isinstance(event, SpeechChange):
            self._changes.append(event)
        elif isinstance(event, Progress):
            self._levels.append((event.time_s, event.level_db))
            if event.pitch_hz > 0.0:
                self._pitches.append((event.time_s, event.pitch_hz))

    def _tell_lips(self, event: SoundEvent) -> None:
        self._lips.accept(event)
        self._recent.append(event)
        while _time_of(self._recent[0]) < self._event_s - _RECENT_S:
            self._recent.popleft()

    def _withdraw(self) -> None:
        """Take back the phones of a lost recognizer that the one after it does not confirm."""
        for phone in self._phones.take_withdrawn():
            self._tell_lips(phone)

    def _number_at(self, time_s: float) -> int:
        """Return the number of the frame at or after a media time."""
        return math.ceil(time_s * self._frame_rate_hz - _ROUNDING)

    def _frames_until(self, time_s: float) -> Iterator[Frame]:
        """Yield frames not made yet that are due when the sound is known up to ``time_s``."""
        last = math.floor((time_s - self._delay_s) * self._frame_rate_hz + _ROUNDING)
        if last >= self._next_frame:
            self._withdraw()
        while self._next_frame <= last:
            number = self._next_frame
            self._next_frame += 1
            self._time_s = number / self._frame_rate_hz
            self._follow_speech(self._time_s)
            mouth = self._lips.frame_at(self._time_s)
            if number >= self._first_seen:
                yield self._frame(mouth)
            else:
                self._rehearse(mouth)

    def _follow_speech(self, time_s: float) -> None:
        while self._changes and self._changes[0].time_s <= time_s:
            change = self._changes.popleft()
            self._is_speaking = change.active
            if change.active:  # what came before is noise
                self._levels = [level for level in self._levels if level[0] >= change.time_s]

    def _will_speak(self) -> bool:
        soon_s = self._time_s + _SPEECH_LEAD_S
        return any(each.active and each.time_s <= soon_s for each in self._changes)

    def _frame(self, mouth: MouthFrame) -> Frame:
        rehearsed = self._own
        faps = self._rehearse(mouth)
        if self._is_resuming and self._shown is not None:
            self._is_resuming = False
            own = faps if rehearsed is None else rehearsed
            self._lead(Motion(self._shown - own, _NOTHING))
        self._difference_s += 1.0 / self._frame_rate_hz
        left = self._difference.at(self._difference_s).value
        if left.any():
            free = max(self._expression.free, 1.0 - self._difference_s / _BIND_S)
            jaw = faps[JAW] + left[JAW]  # it does not part lips
            mix(faps, left.astype(np.float32), free)
            faps[JAW] = max(jaw, 0.0)
        shown = faps.astype(np.float64)
        self._shown_before = shown if self._shown is None else self._shown
        self._shown = shown
        return self._time_s, faps

    def _rehearse(self, mouth: MouthFrame) -> NDArray[np.float32]:
        """Make the next frame, FAPs (68,), without what is left of a difference."""
        levels, self._levels = self._levels, []
        pitches, self._pitches = self._pitches, []
        self._num_frames += 1
        faps = self._pose(mouth, 1.0 / self._frame_rate_hz, levels, pitches)
        self._own = faps.astype(np.float64)
        return faps

    def _pose(
        self,
        mouth: MouthFrame,
        step_s: float = 0.0,
        levels: Sequence[tuple[float, float]] = (),
        pitches: Sequence[tuple[float, float]] = (),
    ) -> NDArray[np.float32]:
        """Return the FAPs (68,) of a mouth and all else, ``step_s`` after the frame before."""
        faps = np.zeros(NUM_FAPS, dtype=np.float32)
        faps[_MOUTH] = mouth.faps
        moment = Moment(
            time_s=self._time_s,
            known_s=self._time_s + self._delay_s,
            elapsed_s=(self._num_frames - 1) / self._frame_rate_hz,
            step_s=step_s,
            is_speaking=self._is_speaking or self._will_speak(),
            levels=levels,
            pitches=pitches,
            articulation=mouth.articulation,
            amplitude_applies=self._lip_model.amplitude_applies,
        )
        for modifier in self._modifiers:
            modifier.apply(faps, moment)
        return faps


def _time_of(event: SoundEvent) -> float:
    return event.onset_s if isinstance(event, Phone) else event.time_s
