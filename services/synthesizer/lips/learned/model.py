"""Live learned lips: turns predicted lip positions and phones into mouth FAPs.

    lip positions -> stabilize -> closures -> lip track -> transition -> rest
    phones -> dynamic visemes -> tongue

The recognizer predicts ``LipPositions`` from the audio, 50 per second during speech. Small changes
are reduced, because they are jitter. Closures depend on lip positions and on recognized phones
(`closure_rule`). Each closure lasts at least 40 ms. Tongue and jaw thrust, which cameras do not
track, come from the dynamic visemes. The lip positions already contain the effect of loudness, so
the amplitude modifier is off.

Lip positions are processed once, when their FAP frame is due, without waiting for the next. If they
are late, a *transition* keeps the mouth and its velocity continuous. After the last lip positions,
the track closes within 150 ms. In pauses, the lips stay ajar (`resting_lips`). Until the first lip
positions arrive, the dynamic visemes move the whole mouth.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.learned.closure_rule import (
    ClosingPhones,
    ClosureRule,
    close_lips,
    compute_closure_amount,
    log_odds_of,
    move_lip_to_teeth,
    separate_lips,
)
from kouxing.services.synthesizer.lips.learned.lip_track import HOLD_S, MAX_GAP_S, LipTrack
from kouxing.services.synthesizer.lips.learned.resting_lips import AJAR, RestingLips
from kouxing.services.synthesizer.lips.lip_model import Articulation, MouthFrame
from kouxing.services.synthesizer.lips.trajectory import (
    NO_TRANSITION,
    SLOW_TRANSITION_S,
    TRANSITION_S,
    FapState,
    RestTransition,
    Transition,
    stationary_state,
)
from kouxing.shared.arrays import Doubles
from kouxing.shared.face.faps import MOUTH_FAPS, MOUTH_WIDTH_FAPS, NUM_MOUTH_FAPS, TONGUE_FAPS
from kouxing.shared.phones.events import LipPositions, Phone, SoundEvent, SpeechChange

_REST_S = 0.15  # duration of the return to rest without sound
_FLUSHED_S = 0.3  # lip positions of this much audio may arrive after an interruption
_MEMORY_S = 0.5
_TEETH_LOG_ODDS = 1.0  # threshold for a phone f
_CLOSED_FRACTION = 0.5  # lips count as closed from this closure amount
_JITTER = 10.0  # FAP units: changes of this size are halved, smaller changes are reduced further
_MAX_FAP = 4000.0  # FAP units; larger values are invalid
_EPSILON = 1e-6  # FAP units, and FAP units per second

_UNTRACKED = np.array([MOUTH_FAPS.index(fap) for fap in (14, *TONGUE_FAPS)])  # 14: jaw thrust
# the movements of the mouth corners are a third as large
_JITTER_SQUARED = np.array(
    [(_JITTER / 3.0 if fap in MOUTH_WIDTH_FAPS else _JITTER) ** 2 for fap in MOUTH_FAPS]
)


@dataclass(frozen=True, slots=True)
class LearnedLips:
    """The lip model that uses predicted lip positions, with the tongue of the dynamic visemes."""

    amplitude_applies: ClassVar[bool] = False

    visemes: DynamicVisemes
    closures: ClosureRule = field(default_factory=ClosureRule)

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> LearnedStream:
        """Start a session at rest; see ``LipModel.stream``."""
        return LearnedStream(
            self.visemes, self.closures, start_s, frame_rate_hz=frame_rate_hz, delay_s=delay_s
        )


class LearnedStream:
    """A session of learned lips; implements ``LipStream``."""

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
        self._queue: deque[LipPositions] = deque()  # not due yet
        self._newest_s = -np.inf  # time of the newest lip positions
        self._stable = self._neutral  # the last lip positions, stabilized
        self._closing = (0.0, 0.0)  # closure fractions of the last two lip positions
        self._has_lip_positions = False
        self._is_speaking = False
        self._flushed_until_s = -np.inf  # lip positions of earlier audio are ignored
        self._known_s = start_s  # end of the audio on which the newest lip positions depend
        self._track = LipTrack(self._neutral)
        self._on_track = stationary_state(self._neutral)  # the track at the last frame
        self._transition = NO_TRANSITION
        self._rest: RestTransition | None = None  # set while media time does not advance
        self._resting = RestingLips()
        self._ajar = 0.0  # fraction of the ajar mouth at the last frame
        self._late_s = 0.0  # lateness of the newest lip positions
        self._time_s = start_s  # time of the last frame
        self._mouth = stationary_state(self._neutral)
        self._tongue = self._neutral

    def add_event(self, event: SoundEvent) -> None:
        """Add lip positions, a phone, a revision, a level, or a change of voice activity."""
        self._visemes.add_event(event)
        self._resting.add_event(event)
        match event:
            case LipPositions():
                self._add_lip_positions(event)
            case Phone():
                for phones in (self._bilabials, self._labiodentals):
                    phones.add(event)
            case SpeechChange():
                self._flushed_until_s = -np.inf
                self._is_speaking = event.active

    def _add_lip_positions(self, positions: LipPositions) -> None:
        numbers = (positions.time_s, positions.delay_s, positions.closure)
        is_valid = all(map(math.isfinite, numbers)) and (np.abs(positions.faps) < _MAX_FAP).all()
        is_new = positions.time_s > self._newest_s
        known_s = positions.time_s + positions.delay_s
        if not is_valid or not is_new or known_s <= self._flushed_until_s:
            return
        self._queue.append(positions)
        self._newest_s = positions.time_s
        self._known_s = known_s
        self._has_lip_positions = True

    def flush(self) -> None:
        """Drop the known events and return to rest within 150 ms."""
        self._visemes.flush()
        self._resting.flush()
        self._queue.clear()
        for phones in (self._bilabials, self._labiodentals):
            phones.clear()
        self._track, self._on_track = LipTrack(self._neutral), stationary_state(self._neutral)
        self._flushed_until_s = self._known_s + _FLUSHED_S
        self._start_transition(stationary_state(self._neutral), SLOW_TRANSITION_S)

    def frame_at(self, time_s: float) -> MouthFrame:
        """Return the mouth at a media time, seconds; times increase."""
        visemes = self._visemes.frame_at(time_s)
        self._tongue = visemes.faps
        self._resting.process_until(time_s)
        if self._has_lip_positions:
            self._update_mouth(time_s)
        else:
            self._follow_visemes(visemes.faps, max(time_s - self._time_s, 1e-3))
        self._ajar = self._resting.amount_at(time_s)
        self._time_s = time_s
        return self._frame(visemes.articulation)

    def relax(self, step_s: float) -> MouthFrame:
        """Return the mouth one step closer to rest."""
        visemes = self._visemes.relax(step_s)
        self._tongue = visemes.faps
        self._ajar = self._resting.relax(step_s)
        if not self._has_lip_positions:
            self._follow_visemes(visemes.faps, step_s)
            return self._frame(visemes.articulation)
        if self._rest is None:
            self._rest = RestTransition(self._mouth, self._neutral, _REST_S)
        self._mouth = self._rest.step(step_s)
        return self._frame(visemes.articulation)

    def _follow_visemes(self, faps: Doubles, step_s: float) -> None:
        """Move like the dynamic visemes; the first lip positions start a transition from here."""
        self._mouth = FapState(faps, (faps - self._mouth.value) / step_s)
        self._on_track = self._mouth

    def _update_mouth(self, time_s: float) -> None:
        continues = self._track.end_s >= self._time_s
        self._extend_track(time_s)
        if self._rest is not None or not continues:
            now = self._track.at(self._time_s)
            if self._rest is not None:
                self._start_transition(now, SLOW_TRANSITION_S)
            elif _is_different(self._on_track, now):
                self._start_transition(now, TRANSITION_S)
        self._on_track = self._track.at(time_s)
        self._mouth = self._on_track + self._transition.at(time_s)

    def _start_transition(self, target: FapState, duration_s: float) -> None:
        """Start a transition from the current mouth to a target."""
        durations_s = np.full(NUM_MOUTH_FAPS, duration_s)
        self._transition = Transition(self._mouth - target, durations_s, self._time_s)
        self._rest = None

    def _extend_track(self, time_s: float) -> None:
        """Extend the track to a time, if enough lip positions have arrived."""
        self._track.forget_before(self._time_s)
        for phones in (self._bilabials, self._labiodentals):
            phones.forget_before(time_s - _MEMORY_S)
        while self._queue and self._track.end_s < time_s:
            positions = self._queue.popleft()
            self._track.append(positions.time_s, self._stabilize(positions))
            # lip positions with a longer delay than the face are late
            self._late_s = max(0.0, positions.delay_s - self._delay_s)
        self._track.hold_s = HOLD_S + self._late_s if self._is_speaking else 0.0

    def _stabilize(self, positions: LipPositions) -> Doubles:
        """Return the FAPs of the next lip positions, stabilized and with closures."""
        faps = positions.faps.astype(np.float64)
        if positions.time_s - self._track.end_s <= MAX_GAP_S:
            change = faps - self._stable
            faps = self._stable + change**3 / (change**2 + _JITTER_SQUARED)
        else:
            self._closing = (0.0, 0.0)
        self._stable = faps
        faps = faps.copy()
        separate_lips(faps)
        rule = self._rule
        teeth = self._labiodentals.log_odds(positions.time_s) - _TEETH_LOG_ODDS
        phones = self._bilabials.log_odds(positions.time_s)
        closure = rule.log_odds(faps, log_odds_of(positions.closure), phones)
        closure -= self._resting.silence_penalty_at(positions.time_s, positions.closure, phones)
        move_lip_to_teeth(faps, compute_closure_amount(teeth, rule.doubt))
        closing = compute_closure_amount(closure, rule.doubt)
        before, newest = self._closing
        if before < _CLOSED_FRACTION <= newest:  # a new closure lasts at least two frames
            closing = max(closing, newest)
        self._closing = (newest, closing)
        close_lips(faps, closing)
        return faps

    def _frame(self, articulation: Articulation) -> MouthFrame:
        faps = self._mouth.value.copy()
        separate_lips(faps)  # an interrupted closing movement overshoots
        faps += self._ajar * (AJAR - faps)
        faps[_UNTRACKED] = self._tongue[_UNTRACKED]
        return MouthFrame(faps, articulation)


def _is_different(a: FapState, b: FapState) -> bool:
    return bool(
        np.abs(a.value - b.value).max() > _EPSILON
        or np.abs(a.velocity - b.velocity).max() > _EPSILON
    )
