"""One session's face, without sockets: sound events in, FAP frames out.

    events -> lip model -> modifiers -> frames

Frames are clocked by media time, so they do not depend on when the events arrive. The caller
decides when a stream has stalled and asks for frames that lead to rest (`Face.relax`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.lips.dynamic_visemes.trajectory import NO_TRANSITION, Motion, Transition
from services.synthesizer.lips.lip_model import LipModel, MouthFrame
from services.synthesizer.modifiers.amplitude import Amplitude
from services.synthesizer.modifiers.expression import Expression
from services.synthesizer.modifiers.expressiveness import Expressiveness
from services.synthesizer.modifiers.life import Life
from services.synthesizer.modifiers.modifier import Modifier, Moment
from shared.errors import UserError
from shared.face.faps import MOUTH_FAPS, NUM_FAPS
from shared.phones.events import EndOfSound, Phone, Progress, SoundEvent, SpeechChange

Frame: TypeAlias = tuple[float, NDArray[np.float32]]  # media time in seconds, FAPs (68,)

MAX_DELAY_S = 1.5  # live at most 0.3; further ahead a viseme weighs less than a face can show
MAX_GAP_S = 10.0  # of media time that is filled with frames
REST_S = 0.3  # frames that lead to rest after the end of the sound
_RECENT_S = 2.0  # of events that a new lip model is told
_CATCH_UP_FRAMES = 10  # that it makes before it is seen
_CHANGE_S = 0.14  # from one lip model to the next
_SPEECH_LEAD_S = 0.04  # speech that begins within this, if known, counts as begun
_ROUNDING = 0.01  # of media time, in frames, that is forgiven

_MOUTH = np.array(MOUTH_FAPS) - 1


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
        self._event_s = 0.0  # of the last event
        self._begin(0.0)

    def _begin(self, start_s: float) -> None:
        """Begin at rest, with the next frame at or after a media time."""
        self._next_frame = math.ceil(start_s * self._frame_rate_hz - _ROUNDING)
        self._time_s = self._next_frame / self._frame_rate_hz  # of the last frame
        self._is_speaking = False  # at the last frame
        self._changes: deque[SpeechChange] = deque()  # of frames to come
        self._levels: list[tuple[float, float]] = []  # since the last frame
        self._pitches: list[tuple[float, float]] = []  # since the last frame
        self._recent: deque[SoundEvent] = deque()  # those a new lip model is told
        self._mouth = self._mouth_before = np.zeros(len(MOUTH_FAPS))  # of the last two frames
        self._change, self._change_s = NO_TRANSITION, 0.0  # from the lip model before; its age
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
        time_s = _time_of(event)
        if time_s - self._event_s > MAX_GAP_S:
            self.restart(time_s)
        self._event_s = time_s
        if isinstance(event, EndOfSound):
            self._accept(SpeechChange(active=False, time_s=time_s))
            return self._frames_until(time_s + self._delay_s + REST_S)
        self._accept(event)
        return self._frames_until(time_s) if isinstance(event, Progress) else []

    def restart(self, time_s: float) -> None:
        """Forget all events; the sound goes on at ``time_s``, with phones counted from 0 again."""
        self._event_s = time_s
        self._begin(max(0.0, time_s - self._delay_s))

    def relax(self, num_frames: int) -> list[Frame]:
        """Return frames that lead to rest while no sound comes.

        All carry the media time of the last frame. When sound comes again, the face goes on from
        where it is then.
        """
        step_s = 1.0 / self._frame_rate_hz
        self._follow_speech(math.inf)
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
        before, now = np.zeros((2, len(MOUTH_FAPS)))
        for number in range(1, _CATCH_UP_FRAMES + 1):
            before, now = now, stream.frame_at(begin_s + number * step_s).faps
        shown = Motion(self._mouth, (self._mouth - self._mouth_before) / step_s)
        self._change = Transition(
            shown - Motion(now, (now - before) / step_s), np.full(len(MOUTH_FAPS), _CHANGE_S)
        )
        self._change_s = 0.0
        self._lip_model, self._lips = lips, stream

    def _accept(self, event: SoundEvent) -> None:
        self._lips.accept(event)
        self._recent.append(event)
        while _time_of(self._recent[0]) < self._event_s - _RECENT_S:
            self._recent.popleft()
        if isinstance(event, SpeechChange):
            self._changes.append(event)
        elif isinstance(event, Progress):
            self._levels.append((event.time_s, event.level_db))
            if event.pitch_hz > 0.0:
                self._pitches.append((event.time_s, event.pitch_hz))

    def _frames_until(self, time_s: float) -> list[Frame]:
        """Frames not made yet that are due when the sound is known up to ``time_s``."""
        frames = []
        last = math.floor((time_s - self._delay_s) * self._frame_rate_hz + _ROUNDING)
        for number in range(self._next_frame, last + 1):
            self._time_s = number / self._frame_rate_hz
            self._follow_speech(self._time_s)
            frames.append(self._frame(self._lips.frame_at(self._time_s)))
        self._next_frame = max(self._next_frame, last + 1)
        return frames

    def _follow_speech(self, time_s: float) -> None:
        while self._changes and self._changes[0].time_s <= time_s:
            self._is_speaking = self._changes.popleft().active

    def _will_speak(self) -> bool:
        soon_s = self._time_s + _SPEECH_LEAD_S
        return any(each.active and each.time_s <= soon_s for each in self._changes)

    def _frame(self, mouth: MouthFrame) -> Frame:
        self._change_s += 1.0 / self._frame_rate_hz
        self._mouth_before = self._mouth
        self._mouth = mouth.faps + self._change.at(self._change_s).value
        faps = np.zeros(NUM_FAPS, dtype=np.float32)
        faps[_MOUTH] = self._mouth
        moment = Moment(
            time_s=self._time_s,
            known_s=self._time_s + self._delay_s,
            elapsed_s=self._num_frames / self._frame_rate_hz,
            step_s=1.0 / self._frame_rate_hz,
            is_speaking=self._is_speaking or self._will_speak(),
            levels=self._levels,
            pitches=self._pitches,
            articulation=mouth.articulation,
            amplitude_applies=self._lip_model.amplitude_applies,
        )
        for modifier in self._modifiers:
            modifier.apply(faps, moment)
        self._levels, self._pitches = [], []
        self._num_frames += 1
        return self._time_s, faps


def _time_of(event: SoundEvent) -> float:
    return event.onset_s if isinstance(event, Phone) else event.time_s
