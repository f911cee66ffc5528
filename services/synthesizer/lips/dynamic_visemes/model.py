"""Dynamic visemes live: phones as they are recognised in, mouth FAPs out.

Source: Li et al. 2011, 2.3.3 (blend the last phone and the one before it, from apex to apex: L1
from silence to the first phone, L2, L3, ..., L4 to silence again).

The *target trajectory* follows from the phones known so far. A live recognizer revises them, and
each revision gives another trajectory. The mouth stays continuous in position and velocity: a
*transition* leads the difference between the old and the new trajectory to zero along a cubic. It
is shorter where a lip must close sooner.

Delay: a frame is made when the sound is known up to ``delay_s`` after it, with all phones known
then. Visemes within that reach take part besides the pair of eq. 11, so a longer delay comes closer
to the full model (Wang & Cai 2003, eq. 6).

Lips move before they sound, but a phone is recognised about a tenth of a second after its onset. So
the mouth sets out for what usually follows (`timeline`): an expected viseme stands after the last
phone. As long as no phone follows, it moves on, just ahead of the time up to which one would have
been recognised. This halves the delay of the lips at short delays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.blending import active_visemes
from kouxing.services.synthesizer.lips.dynamic_visemes.closures import ClosureTracker
from kouxing.services.synthesizer.lips.dynamic_visemes.known_phones import KnownPhones
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import (
    NUM_MOUTH_FAPS,
    VisemeParameters,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.trajectory import (
    NO_TRANSITION,
    Motion,
    Rest,
    TargetTrajectory,
    Transition,
    motionless,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import check_visemes
from kouxing.services.synthesizer.lips.lip_model import MouthFrame
from kouxing.shared.phones.events import Phone, SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

_REST_S = 0.3  # to rest when no sound comes
_TRANSITION_S = 0.04  # from one target trajectory to the next
_SLOW_TRANSITION_S = 0.14  # to rest after an interruption, and back from rest
_MEMORY_S = 1.5  # phones that ended longer ago have no weight left


@dataclass(frozen=True, slots=True)
class DynamicVisemes:
    """The lip model of Li et al. 2011, for the phones of a language.

    Raises
    ------
    UserError
        If the language names visemes that the model lacks.
    """

    amplitude_applies: ClassVar[bool] = True

    parameters: VisemeParameters
    inventory: PhoneInventory

    def __post_init__(self) -> None:
        check_visemes(self.inventory)

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> VisemeStream:
        """Start a session at rest, as ``LipModel.stream``."""
        return VisemeStream(self, start_s, frame_rate_hz=frame_rate_hz, delay_s=delay_s)


@dataclass(frozen=True, slots=True)
class VisemeArticulation:
    """What is being said, by a timeline of visemes; implements ``Articulation``."""

    timeline: Timeline
    level_db: NDArray[np.float64]  # (num_visemes,) usual level, relative to the speaker's mean

    @property
    def syllable_onsets_s(self) -> NDArray[np.float64]:
        """When each syllable's vowel begins, shape (num_syllables,), rising; media time."""
        return self.timeline.syllable_s

    def usual_level_db(self, time_s: float) -> float | None:
        """Level of the viseme nearest to a time; None if there is none."""
        viseme = self.timeline.nearest(time_s)
        return None if viseme is None else float(self.level_db[viseme])


class VisemeStream:
    """One session of dynamic visemes; implements ``LipStream``."""

    def __init__(
        self, model: DynamicVisemes, start_s: float, *, frame_rate_hz: float, delay_s: float
    ) -> None:
        self._parameters = parameters = model.parameters
        self._delay_s = delay_s
        # No target trajectory leaves the hull of the targets. A transition may, and is held there:
        # lips that meet do not pass through each other.
        hull = np.vstack([parameters.target, parameters.neutral])
        self._lowest, self._highest = hull.min(axis=0), hull.max(axis=0)
        self._known = KnownPhones(model.inventory)
        self._closures = ClosureTracker(parameters, frame_rate_hz)
        self._timeline = self._known.timeline()
        self._seen = self._timeline  # at the last frame: open phone extended, late closures moved
        self._trajectory = TargetTrajectory(parameters, self._timeline)
        self._transition, self._transition_start_s = NO_TRANSITION, start_s
        self._pending_s: float | None = None  # duration of the transition that new events ask for
        self._rest: Rest | None = None  # while media time stands still
        self._time_s = start_s  # of the last frame
        self._mouth = motionless(parameters.neutral)

    def accept(self, event: SoundEvent) -> None:
        """Take a phone, a revision, or the end of speech."""
        if isinstance(event, Phone) and self._known.accept_phone(event):
            self._pending_s = max(self._pending_s or 0.0, _TRANSITION_S)
        elif isinstance(event, SpeechChange) and self._known.accept_speech(event):
            self._pending_s = _SLOW_TRANSITION_S  # it may come late

    def flush(self) -> None:
        """Drop every phone known so far and return to rest within 150 ms."""
        self._known.flush()
        self._closures.flush()
        self._rest = None
        self._pending_s = _SLOW_TRANSITION_S

    def frame_at(self, time_s: float) -> MouthFrame:
        """Return the mouth at a media time, seconds; times rise."""
        if self._pending_s is not None:
            self._closures.forget(self._known.forget_before(self._time_s - _MEMORY_S))
            self._timeline = self._known.timeline()
        extended = self._timeline.extend_open_phone(time_s + self._delay_s)
        self._seen, is_postponed = self._closures.postpone(extended, self._time_s, time_s)
        active = self._seen.select(active_visemes(self._seen, time_s, self._delay_s))
        is_same = active.same_visemes(self._trajectory.timeline)
        self._trajectory = TargetTrajectory(self._parameters, active)
        if self._pending_s is not None or is_postponed or not is_same or self._rest is not None:
            self._start_transition()
        left = self._transition.at(time_s - self._transition_start_s)
        self._mouth = self._within_hull(self._trajectory.at(time_s) + left)
        self._time_s = time_s
        self._closures.note(active, time_s, self._mouth.value)
        return self._frame()

    def relax(self, step_s: float) -> MouthFrame:
        """Lead the mouth to rest by one more step; media time stands still."""
        if self._rest is None:
            duration_s = _REST_S if len(self._known) else _SLOW_TRANSITION_S
            self._rest = Rest(self._mouth, self._parameters.neutral, duration_s)
        self._mouth = self._within_hull(self._rest.step(step_s))
        return self._frame()

    def _start_transition(self) -> None:
        """Lead the mouth from where it is to the target trajectory."""
        asked_s = self._pending_s or _TRANSITION_S
        duration_s = _SLOW_TRANSITION_S if self._rest is not None else asked_s
        self._transition = Transition(
            self._mouth - self._trajectory.at(self._time_s),
            self._closures.shorten(
                np.full(NUM_MOUTH_FAPS, duration_s), self._trajectory.timeline, self._time_s
            ),
        )
        self._transition_start_s = self._time_s
        self._pending_s = self._rest = None

    def _within_hull(self, motion: Motion) -> Motion:
        value = np.clip(motion.value, self._lowest, self._highest)
        return Motion(value, np.where(value == motion.value, motion.slope, 0.0))

    def _frame(self) -> MouthFrame:
        articulation = VisemeArticulation(self._seen, self._parameters.level_db)
        return MouthFrame(self._mouth.value, articulation)
