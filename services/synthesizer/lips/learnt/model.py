"""Learnt lips live: lip frames and phones in, mouth FAPs out.

    lip frames -> steady -> closures -> track -> transition
    phones -> dynamic visemes -> tongue

The recognizer makes lip frames of the sound itself (``LipFrame``), 50 a second while somebody
speaks. Trembling is steadied: a change fades the more, the smaller it is. Closures are decided with
the recognised phones (`closures`); each lasts for two lip frames at least, so that none flutters.
What no camera tracks, tongue and jaw thrust, comes from the dynamic visemes. The sound tells how
far the mouth opens, so no amplitude is applied.

A lip frame is shaped once, when its face is due, by what is known then; none waits for the next.
Where frames are late, a *transition* leads the mouth to them, continuous in position and velocity.
After the last lip frame the mouth goes to rest within 150 ms. As long as a recognizer has sent no
lip frame at all, the dynamic visemes move the whole mouth.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import NUM_MOUTH_FAPS
from kouxing.services.synthesizer.lips.dynamic_visemes.trajectory import (
    NO_TRANSITION,
    Motion,
    Rest,
    Transition,
    motionless,
)
from kouxing.services.synthesizer.lips.learnt.closures import (
    ClosingPhones,
    ClosureRule,
    close_lips,
    lip_to_teeth,
    log_odds_of,
    part_lips,
    shut_share,
)
from kouxing.services.synthesizer.lips.learnt.track import HOLD_S, MAX_GAP_S, LipTrack
from kouxing.services.synthesizer.lips.lip_model import Articulation, MouthFrame
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import LipFrame, Phone, SoundEvent, SpeechChange

Array = NDArray[np.float64]

_UNTRACKED_FAPS = (14, 44, 45, 46, 47)  # jaw thrust and tongue
_TRANSITION_S = 0.04  # from one track to the next
_SLOW_TRANSITION_S = 0.14  # to rest after an interruption, and back from rest
_REST_S = 0.15  # to rest when no sound comes
_FLUSHED_S = 0.3  # of sound, whose lip frames may still be on their way after an interruption
_MEMORY_S = 0.5
_TEETH_LOG_ODDS = 1.0  # that a phone f needs: the sound tells lip to teeth too badly
_SHUT_SHARE = 0.5  # of the way to a closure, from which on lips count as shut
_TREMBLING = 10.0  # FAP units: changes of this size are halved, smaller ones fade, larger ones stay
_MAX_FAP = 4000.0  # FAP units; more is no mouth
_SAME = 1e-6  # FAP units, and FAP units per second

_WIDTH_FAPS = (6, 7, 53, 54)  # of the mouth's corners, which move a third as far
_UNTRACKED = [MOUTH_FAPS.index(fap) for fap in _UNTRACKED_FAPS]
_TREMBLING_POWER = np.array(
    [(_TREMBLING / 3.0 if fap in _WIDTH_FAPS else _TREMBLING) ** 2 for fap in MOUTH_FAPS]
)


@dataclass(frozen=True, slots=True)
class LearntLips:
    """Lips from sound, with the tongue of the dynamic visemes."""

    amplitude_applies: ClassVar[bool] = False

    visemes: DynamicVisemes
    closures: ClosureRule = field(default_factory=ClosureRule)

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> LearntStream:
        """Start a session at rest, as ``LipModel.stream``."""
        return LearntStream(
            self.visemes, self.closures, start_s, frame_rate_hz=frame_rate_hz, delay_s=delay_s
        )


class LearntStream:
    """One session of learnt lips; implements ``LipStream``."""

    def __init__(
        self,
        visemes: DynamicVisemes,
        rule: ClosureRule,
        start_s: float,
        *,
        frame_rate_hz: float,
        delay_s: float,
    ) -> None:
        self._rule = rule
        self._visemes = visemes.stream(start_s, frame_rate_hz=frame_rate_hz, delay_s=delay_s)
        self._delay_s = delay_s
        self._neutral = visemes.parameters.neutral
        self._bilabials, self._labiodentals = (
            ClosingPhones(visemes.inventory, viseme, rule) for viseme in ("b", "f")
        )
        self._waiting: deque[LipFrame] = deque()  # not yet due
        self._newest_s = -np.inf  # time of the newest lip frame
        self._steady = self._neutral  # the last lip frame, steadied
        self._shares = (0.0, 0.0)  # how far the last two lip frames are shut
        self._has_lips = False  # a lip frame has come
        self._is_speaking = False
        self._deaf_until_s = -np.inf  # lip frames of the sound up to here were interrupted
        self._known_s = start_s  # the newest lip frame knew the sound up to here
        self._track = LipTrack(self._neutral)
        self._transition, self._transition_start_s = NO_TRANSITION, start_s
        self._rest: Rest | None = None  # while media time stands still
        self._late_s = 0.0  # by which the newest lip frame came after its face was due
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
                    phones.accept(event, self._time_s)
            case SpeechChange():
                self._deaf_until_s = -np.inf
                self._is_speaking = event.active

    def _accept_lips(self, frame: LipFrame) -> None:
        numbers = (frame.time_s, frame.delay_s, frame.closure)
        is_mouth = np.isfinite(numbers).all() and (np.abs(frame.faps) < _MAX_FAP).all()
        is_new = frame.time_s > self._newest_s
        if not is_mouth or not is_new or frame.time_s + frame.delay_s <= self._deaf_until_s:
            return
        self._waiting.append(frame)
        self._newest_s = frame.time_s
        self._known_s = frame.time_s + frame.delay_s
        self._has_lips = True

    def flush(self) -> None:
        """Drop what is known and return to rest within 150 ms."""
        self._visemes.flush()
        self._waiting.clear()
        for phones in (self._bilabials, self._labiodentals):
            phones.clear()
        self._track = LipTrack(self._neutral)
        self._deaf_until_s = self._known_s + _FLUSHED_S
        self._lead_to(motionless(self._neutral), _SLOW_TRANSITION_S)

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
        before = self._track.at(self._time_s)
        self._extend_track(time_s)
        now = self._track.at(self._time_s)
        if self._rest is not None:
            self._lead_to(now, _SLOW_TRANSITION_S)
        elif _differs(before, now):
            self._lead_to(now, _TRANSITION_S)
        left = self._transition.at(time_s - self._transition_start_s)
        self._mouth = self._track.at(time_s) + left

    def _lead_to(self, target: Motion, duration_s: float) -> None:
        """Lead the mouth from where it is to another motion."""
        self._transition = Transition(self._mouth - target, np.full(NUM_MOUTH_FAPS, duration_s))
        self._transition_start_s = self._time_s
        self._rest = None

    def _extend_track(self, time_s: float) -> None:
        """Let the track reach a time, as far as lip frames have come."""
        self._track.forget_before(self._time_s)
        for phones in (self._bilabials, self._labiodentals):
            phones.forget_before(time_s - _MEMORY_S)
        while self._waiting and self._track.end_s < time_s:
            frame = self._waiting.popleft()
            self._track.append(frame.time_s, self._shaped(frame))
            # lips of a longer delay than the face's come late
            self._late_s = max(0.0, frame.delay_s - self._delay_s)
        self._track.hold_s = HOLD_S + self._late_s if self._is_speaking else 0.0

    def _shaped(self, frame: LipFrame) -> Array:
        """Return the FAPs of the next lip frame, steadied and with its closures."""
        faps = frame.faps.astype(np.float64)
        if frame.time_s - self._track.end_s <= MAX_GAP_S:
            change = faps - self._steady
            faps = self._steady + change**3 / (change**2 + _TREMBLING_POWER)
        else:
            self._shares = (0.0, 0.0)
        self._steady = faps
        faps = faps.copy()
        part_lips(faps)
        rule = self._rule
        teeth = self._labiodentals.log_odds(frame.time_s) - _TEETH_LOG_ODDS
        closure = rule.log_odds(
            faps, log_odds_of(frame.closure), self._bilabials.log_odds(frame.time_s)
        )
        lip_to_teeth(faps, shut_share(teeth, rule.doubt))
        share = shut_share(closure, rule.doubt)
        before, newest = self._shares
        if before < _SHUT_SHARE <= newest:  # it has just begun, and lasts for two frames at least
            share = max(share, newest)
        self._shares = (newest, share)
        close_lips(faps, share)
        return faps

    def _frame(self, articulation: Articulation) -> MouthFrame:
        faps = self._mouth.value.copy()
        faps[_UNTRACKED] = self._tongue[_UNTRACKED]
        return MouthFrame(faps, articulation)


def _differs(one: Motion, other: Motion) -> bool:
    return bool(
        np.abs(one.value - other.value).max() > _SAME
        or np.abs(one.slope - other.slope).max() > _SAME
    )
