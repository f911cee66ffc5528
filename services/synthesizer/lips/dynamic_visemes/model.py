"""Live dynamic visemes: turns recognized phones into mouth FAPs.

Source: Li et al. 2011, 2.3.3 (blend the last two phones from apex to apex: L1 from silence to the
first phone, L2, L3, ..., L4 to silence).

The known phones define the *target trajectory*. Each revision by the live recognizer changes it. A
*transition* then fades the difference between the old and new trajectory to zero, so the mouth is
continuous in position and velocity. The transition is shorter if a lip must close earlier.

A frame is made when the audio is known up to ``delay_s`` after it, from all phones known at that
time. In addition to the pair of eq. 11, visemes within ``delay_s`` act. A longer delay is
therefore closer to the full model (Wang & Cai 2003, eq. 6).

Lips move before the sound, but a phone is recognized about 0.1 s after its onset. Therefore the
mouth starts moving toward an expected viseme after the last phone (`timeline`). While no phone
follows, the expected viseme stays just after the time at which a new phone would already be
recognized. This halves the lag of the lips at short delays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from kouxing.services.synthesizer.lips.dynamic_visemes.blending import (
    active_visemes,
    build_sequence_parameters,
    states_at,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.closure_tracker import ClosureTracker
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import VisemeParameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline, build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import check_visemes
from kouxing.services.synthesizer.lips.known_phones import KnownPhones
from kouxing.services.synthesizer.lips.lip_model import MouthFrame
from kouxing.services.synthesizer.lips.trajectory import (
    NO_TRANSITION,
    SLOW_TRANSITION_S,
    TRANSITION_S,
    FapState,
    RestTransition,
    Transition,
    clip_state,
    stationary_state,
)
from kouxing.shared.arrays import Doubles
from kouxing.shared.face.faps import NUM_MOUTH_FAPS
from kouxing.shared.fast_record import Record
from kouxing.shared.phones.events import Phone, SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

_REST_S = 0.3  # duration of the return to rest without sound
_MEMORY_S = 1.5  # phones that ended earlier have no effect


@dataclass(frozen=True, slots=True)
class DynamicVisemes:
    """The lip model of Li et al. 2011, for the phones of a language.

    Raises ``UserError`` if the language uses visemes that the model does not have.
    """

    amplitude_applies: ClassVar[bool] = True

    parameters: VisemeParameters
    inventory: PhoneInventory

    def __post_init__(self) -> None:
        check_visemes(self.inventory)

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> VisemeStream:
        """Start a session at rest; see ``LipModel.stream``."""
        return VisemeStream(self, start_s, frame_rate_hz=frame_rate_hz, delay_s=delay_s)


class VisemeArticulation(Record, frozen=True):
    """The articulation of a timeline of visemes; implements ``Articulation``."""

    timeline: Timeline
    level_db: Doubles  # (num_visemes,) usual level, relative to the speaker's mean

    @property
    def syllable_onsets_s(self) -> Doubles:
        """Syllable onsets; see ``Articulation``."""
        return self.timeline.syllable_s

    def usual_level_db(self, time_s: float) -> float | None:
        """Return the level of the viseme nearest to a time; None without visemes."""
        viseme = self.timeline.nearest(time_s)
        return None if viseme is None else float(self.level_db[viseme])


class VisemeStream:
    """A session of dynamic visemes; implements ``LipStream``."""

    def __init__(
        self, model: DynamicVisemes, start_s: float, *, frame_rate_hz: float, delay_s: float
    ) -> None:
        self._parameters = parameters = model.parameters
        self._delay_s = delay_s
        # Target trajectories stay within the hull of the targets. Transitions may leave it and are
        # clipped, so that closed lips do not pass through each other.
        hull = np.vstack([parameters.target, parameters.neutral])
        self._lowest, self._highest = hull.min(axis=0), hull.max(axis=0)
        self._inventory = model.inventory
        self._known = KnownPhones(model.inventory)
        self._closures = ClosureTracker(parameters, frame_rate_hz)
        self._timeline = self._build_timeline()
        self._current = self._timeline  # with open phone extended and late closures moved
        self._active = self._timeline  # visemes that act at the time of the last frame
        self._sequence = build_sequence_parameters(parameters, self._timeline)
        self._transition = NO_TRANSITION
        self._pending_s: float | None = None  # duration of the transition for new events
        self._rest: RestTransition | None = None  # set while media time does not advance
        self._time_s = start_s  # time of the last frame
        self._mouth: Callable[[], FapState] = lambda: stationary_state(parameters.neutral)

    def add_event(self, event: SoundEvent) -> None:
        """Add a phone, a revision, or the end of speech."""
        if isinstance(event, Phone) and self._known.add_phone(event):
            self._pending_s = max(self._pending_s or 0.0, TRANSITION_S)
        elif isinstance(event, SpeechChange) and self._known.add_speech_change(event):
            self._pending_s = SLOW_TRANSITION_S  # the event may be late

    def flush(self) -> None:
        """Drop all known phones and return to rest within 150 ms."""
        self._known.flush()
        self._closures.flush()
        self._rest = None
        self._pending_s = SLOW_TRANSITION_S

    def frame_at(self, time_s: float) -> MouthFrame:
        """Return the mouth at a media time, seconds; times increase."""
        if self._pending_s is not None:
            self._closures.forget(self._known.forget_before(self._time_s - _MEMORY_S))
            self._timeline = self._build_timeline()
        extended = self._timeline.extend_open_phone(time_s + self._delay_s)
        self._current, is_postponed = self._closures.postpone(extended, self._time_s, time_s)
        active = self._current.select(active_visemes(self._current, time_s, self._delay_s))
        before, self._active = self._active, active
        is_same = active.has_same_visemes(before)
        if not is_same or len(active.silence_start_s) != len(before.silence_start_s):
            self._sequence = build_sequence_parameters(self._parameters, active)
        has_changed = self._pending_s is not None or is_postponed or not is_same
        times_s = [time_s]
        if has_changed or self._rest is not None:
            times_s = [self._time_s, time_s]
        *start, target = states_at(self._parameters, active, times_s, self._sequence)
        if start:
            self._start_transition(*start)
        transition = self._transition
        # most frames need no velocity
        self._mouth = lambda: self._clip_to_hull(target + transition.at(time_s))
        faps = np.maximum(target.value + transition.value_at(time_s), self._lowest)
        faps = np.minimum(faps, self._highest)
        self._time_s = time_s
        self._closures.record_closures(active, time_s, faps)
        return self._frame(faps)

    def relax(self, step_s: float) -> MouthFrame:
        """Return the mouth one step closer to rest."""
        if self._rest is None:
            duration_s = _REST_S if len(self._known) else SLOW_TRANSITION_S
            self._rest = RestTransition(self._mouth(), self._parameters.neutral, duration_s)
        mouth = self._clip_to_hull(self._rest.step(step_s))
        self._mouth = lambda: mouth
        return self._frame(mouth.value)

    def _build_timeline(self) -> Timeline:
        phones = self._known.sorted_by_onset()
        return build_timeline(phones, self._inventory, self._known.speech_ends_s, is_live=True)

    def _start_transition(self, target: FapState) -> None:
        """Start a transition from the current mouth to ``target`` on the target trajectory."""
        requested_s = self._pending_s or TRANSITION_S
        duration_s = SLOW_TRANSITION_S if self._rest is not None else requested_s
        durations_s = np.full(NUM_MOUTH_FAPS, duration_s)
        self._transition = Transition(
            self._mouth() - target,
            self._closures.shorten(durations_s, self._active, self._time_s),
            self._time_s,
        )
        self._pending_s = self._rest = None

    def _clip_to_hull(self, state: FapState) -> FapState:
        return clip_state(state, self._lowest, self._highest)

    def _frame(self, faps: Doubles) -> MouthFrame:
        return MouthFrame(faps, VisemeArticulation(self._current, self._parameters.level_db))
