"""Learnt lips live: lip frames and phones in, mouth FAPs out.

    lip frames -> closures -> track -> transition
    phones -> dynamic visemes -> tongue

The recognizer makes lip frames of the sound itself (``LipFrame``), 50 a second while somebody
speaks. Closures are decided with the recognised phones (`closures`). What no camera tracks, tongue
and jaw thrust, comes from the dynamic visemes. The sound tells how far the mouth opens, so no
amplitude is applied.

A frame of the face is made once, by what is known then. What comes later changes the track: a
*transition* leads the difference to zero, so the mouth stays continuous in position and velocity.
After the last lip frame the mouth goes to rest within 150 ms. As long as a recognizer has sent no
lip frame at all, the dynamic visemes move the whole mouth.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from services.synthesizer.lips.dynamic_visemes.parameters import NUM_MOUTH_FAPS
from services.synthesizer.lips.dynamic_visemes.trajectory import (
    NO_TRANSITION,
    Motion,
    Rest,
    Transition,
    motionless,
)
from services.synthesizer.lips.dynamic_visemes.visemes import CLOSURE_FAPS, VISEME_INDEX
from services.synthesizer.lips.learnt.closures import ClosingPhones, shut_share
from services.synthesizer.lips.learnt.track import HOLD_S, LipTrack
from services.synthesizer.lips.lip_model import Articulation, MouthFrame
from shared.face.faps import MOUTH_FAPS
from shared.phones.events import LipFrame, Phone, SoundEvent, SpeechChange

Array = NDArray[np.float64]

_UNTRACKED_FAPS = (14, 44, 45, 46, 47)  # jaw thrust and tongue
_TRANSITION_S = 0.04  # from one track to the next
_SLOW_TRANSITION_S = 0.14  # to rest after an interruption, and back from rest
_REST_S = 0.15  # to rest when no sound comes
_FLUSHED_S = 0.3  # of sound, whose lip frames may still be on their way after an interruption
_MEMORY_S = 0.5
_MAX_FAP = 4000.0  # FAP units; more is no mouth
_SAME = 1e-6  # FAP units, and FAP units per second

_UNTRACKED = [MOUTH_FAPS.index(fap) for fap in _UNTRACKED_FAPS]


@dataclass(frozen=True, slots=True)
class LearntLips:
    """Lips from sound, with the tongue of the dynamic visemes."""

    amplitude_applies: ClassVar[bool] = False

    visemes: DynamicVisemes

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> LearntStream:
        """Start a session at rest, as ``LipModel.stream``."""
        return LearntStream(self.visemes, start_s, frame_rate_hz=frame_rate_hz, delay_s=delay_s)


class LearntStream:
    """One session of learnt lips; implements ``LipStream``."""

    def __init__(
        self, visemes: DynamicVisemes, start_s: float, *, frame_rate_hz: float, delay_s: float
    ) -> None:
        self._visemes = visemes.stream(start_s, frame_rate_hz=frame_rate_hz, delay_s=delay_s)
        self._delay_s = delay_s
        self._neutral = visemes.parameters.neutral
        self._target = visemes.parameters.target
        self._bilabials, self._labiodentals = (
            ClosingPhones(visemes.inventory, viseme) for viseme in ("b", "f")
        )
        self._frames: deque[LipFrame] = deque()
        self._has_lips = False  # a lip frame has come
        self._is_speaking = False
        self._deaf_until_s = -np.inf  # lip frames of the sound up to here were interrupted
        self._known_s = start_s  # the newest lip frame knew the sound up to here
        self._is_changed = False  # since the track was made
        self._pending_s = _TRANSITION_S  # duration of the next transition
        self._track = self._new_track()
        self._transition, self._transition_start_s = NO_TRANSITION, start_s
        self._rest: Rest | None = None  # while media time stands still
        self._time_s = start_s  # of the last frame
        self._mouth = motionless(self._neutral)
        self._tongue = self._neutral

    def accept(self, event: SoundEvent) -> None:
        """Take a lip frame, a phone, a revision, or a change of voice activity."""
        self._visemes.accept(event)
        match event:
            case LipFrame():
                self._accept_lips(event)
            case Phone():
                for phones in (self._bilabials, self._labiodentals):
                    self._is_changed |= phones.accept(event)
            case SpeechChange():
                self._deaf_until_s = -np.inf
                self._is_changed |= self._is_speaking != event.active
                self._is_speaking = event.active

    def _accept_lips(self, frame: LipFrame) -> None:
        numbers = (frame.time_s, frame.delay_s, frame.closure, frame.lip_to_teeth)
        is_mouth = np.isfinite(numbers).all() and (np.abs(frame.faps) < _MAX_FAP).all()
        is_new = not self._frames or frame.time_s > self._frames[-1].time_s
        if not is_mouth or not is_new or frame.time_s + frame.delay_s <= self._deaf_until_s:
            return
        self._frames.append(frame)
        self._known_s = frame.time_s + frame.delay_s
        self._has_lips = self._is_changed = True

    def flush(self) -> None:
        """Drop what is known and return to rest within 150 ms."""
        self._visemes.flush()
        self._frames.clear()
        self._deaf_until_s = self._known_s + _FLUSHED_S
        self._rest = None
        self._is_changed = True
        self._pending_s = _SLOW_TRANSITION_S

    def frame_at(self, time_s: float) -> MouthFrame:
        """Return the mouth at a media time, seconds; times rise."""
        spoken = self._visemes.frame_at(time_s)
        self._tongue = spoken.faps
        if self._has_lips:
            self._follow_track(time_s)
        else:
            step_s = max(time_s - self._time_s, 1e-3)
            self._mouth = Motion(spoken.faps, (spoken.faps - self._mouth.value) / step_s)
            self._rest = None
        self._time_s = time_s
        return self._frame(spoken.articulation)

    def relax(self, step_s: float) -> MouthFrame:
        """Lead the mouth to rest by one more step; media time stands still."""
        spoken = self._visemes.relax(step_s)
        self._tongue = spoken.faps
        if self._rest is None:
            self._rest = Rest(self._mouth, self._neutral, _REST_S)
        self._mouth = self._rest.step(step_s)
        return self._frame(spoken.articulation)

    def _follow_track(self, time_s: float) -> None:
        if self._is_changed or self._rest is not None:
            before = self._track.at(self._time_s)
            self._forget_before(self._time_s - _MEMORY_S)
            self._track = self._new_track()
            now = self._track.at(self._time_s)
            if self._rest is not None or _differs(before, now):
                self._start_transition(now)
            self._is_changed = False
        left = self._transition.at(time_s - self._transition_start_s)
        self._mouth = self._track.at(time_s) + left

    def _start_transition(self, target: Motion) -> None:
        """Lead the mouth from where it is to the track."""
        duration_s = self._pending_s if self._rest is None else _SLOW_TRANSITION_S
        self._transition = Transition(self._mouth - target, np.full(NUM_MOUTH_FAPS, duration_s))
        self._transition_start_s = self._time_s
        self._pending_s, self._rest = _TRANSITION_S, None

    def _new_track(self) -> LipTrack:
        time_s = np.array([frame.time_s for frame in self._frames])
        faps = np.array([frame.faps for frame in self._frames], dtype=np.float64)
        faps = faps.reshape(-1, NUM_MOUTH_FAPS)
        # bilabials last: lips that meet are not at the teeth
        for viseme, phones, probability in (
            ("f", self._labiodentals, [frame.lip_to_teeth for frame in self._frames]),
            ("b", self._bilabials, [frame.closure for frame in self._frames]),
        ):
            share = shut_share(np.array(probability), phones.log_odds(time_s))[:, None]
            columns = [MOUTH_FAPS.index(fap) for fap in CLOSURE_FAPS[viseme]]
            target = self._target[VISEME_INDEX[viseme], columns]
            faps[:, columns] += share * (target - faps[:, columns])
        return LipTrack(time_s, faps, self._neutral, self._hold_s())

    def _hold_s(self) -> float:
        """How long the last lip frame holds; lips of a longer delay than the face's come late."""
        if not self._frames or not self._is_speaking:
            return 0.0
        return HOLD_S + max(0.0, self._frames[-1].delay_s - self._delay_s)

    def _forget_before(self, time_s: float) -> None:
        while self._frames and self._frames[0].time_s < time_s:
            self._frames.popleft()
        self._bilabials.forget_before(time_s)
        self._labiodentals.forget_before(time_s)

    def _frame(self, articulation: Articulation) -> MouthFrame:
        faps = self._mouth.value.copy()
        faps[_UNTRACKED] = self._tongue[_UNTRACKED]
        return MouthFrame(faps, articulation)


def _differs(one: Motion, other: Motion) -> bool:
    return bool(
        np.abs(one.value - other.value).max() > _SAME
        or np.abs(one.slope - other.slope).max() > _SAME
    )
