"""The live synthesizer: units as they are recognised in, FAP frames out.

Source: Li et al. 2011, 2.3.3 (blend the last unit and the one before it, centre to centre: L1 from
silence to the first unit, L2, L3, ..., L4 to silence again).

The plan, a curve over time, follows from the units known so far. A live recognizer revises them,
and each revision gives another plan. The face must not jump from one to the other: the difference
between the curve put out so far and the new plan, in value and slope, is added to the new plan and
led to zero along a cubic. The time this takes is shortened where a closing lip comes sooner.

Look-ahead: a frame is computed when the sound is known up to ``look_ahead_s`` after it, with all
units known then. Units within that reach take part besides the pair of eq. 11, so that with more
look-ahead the blending goes over into the full model (Wang & Cai 2003, eq. 6).

Lips move before they sound, but a unit is heard of about a tenth of a second after its onset. So
the mouth sets out for what usually follows (`timeline`): an expected viseme stands after the last
unit, and as long as no news comes it moves on, just beyond the time up to which news would have
come. This halves the delay of the lips at short look-aheads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.amplitude import Amplitude
from services.synthesizer.blending import around, blend
from services.synthesizer.gesture import Gesture
from services.synthesizer.parameters import NUM_MOUTH_FAPS, VisemeParameters
from services.synthesizer.timeline import Timeline, build_timeline
from services.synthesizer.visemes import MOUTH_FAPS
from shared.errors import UserError
from shared.faps import NUM_FAPS
from shared.phones import UNIT_INDEX, Phone, SpeechChange

Array = NDArray[np.float64]
FapFrame = tuple[float, NDArray[np.float32]]

LONGEST_LOOK_AHEAD_S = 0.3
_TRANSITION_S = 0.04  # from one plan to the next
_SHORTEST_TRANSITION_S = 0.02  # of lips that must meet at once
_FLUSH_S = 0.14  # to rest after an interruption
REST_S = 0.3  # to rest when no sound comes
_NEWS_S = 0.12  # most units are known so long after their onset: no news, no onset before that
_LATE_CLOSURE_S = 0.1  # a closure recognised up to this much late is still shown, late
_CATCH_UP_S = 0.04  # and takes this long
_CLOSED = 10.0  # FAP units from its target at which a lip counts as closed
_MEMORY_S = 1.5  # units that ended longer ago have no weight left
_BEGUN_S = 0.02
_SLOPE_STEP_S = 1e-3

_MOUTH = np.array(MOUTH_FAPS) - 1


@dataclass(frozen=True, slots=True)
class _Decay:
    """A difference and its slope, led to zero along a cubic: each FAP in its own time."""

    value: Array  # (num_mouth_faps,) FAP units
    slope: Array  # (num_mouth_faps,) FAP units a second
    duration_s: Array  # (num_mouth_faps,)

    def at(self, elapsed_s: float) -> tuple[Array, Array]:
        """Value and slope after ``elapsed_s``, each (num_mouth_faps,)."""
        u = np.minimum(elapsed_s / self.duration_s, 1.0)
        # cubic Hermite from (value, slope) to (0, 0)
        value = (1.0 - u) ** 2 * ((1.0 + 2.0 * u) * self.value + u * self.duration_s * self.slope)
        slope = (1.0 - u) * (-6.0 * u * self.value / self.duration_s + (1.0 - 3.0 * u) * self.slope)
        return value, slope


_NO_DECAY = _Decay(np.zeros(NUM_MOUTH_FAPS), np.zeros(NUM_MOUTH_FAPS), np.ones(NUM_MOUTH_FAPS))


class LiveSynthesizer:
    """FAP frames from units as they arrive; driven by media time, never by the clock.

    Parameters
    ----------
    parameters : VisemeParameters
    frame_rate_hz : float
        Frame ``k`` is at media time ``k / frame_rate_hz``.
    look_ahead_s : float
        0 to 0.3: how much sound after a frame is known when it is computed.
    gesture_seed : int or None
        Seed of blinks, gaze and head motion; None leaves them out.

    Attributes
    ----------
    num_ignored : int
        Units dropped because they made no sense or came from before a flush.
    """

    def __init__(
        self,
        parameters: VisemeParameters,
        *,
        frame_rate_hz: float = 50.0,
        look_ahead_s: float = 0.06,
        gesture_seed: int | None = None,
    ) -> None:
        if not 0.0 <= look_ahead_s <= LONGEST_LOOK_AHEAD_S:
            raise UserError(
                f"look_ahead_s is {look_ahead_s:g}; give 0 to {LONGEST_LOOK_AHEAD_S:g} seconds"
            )
        if not 10.0 <= frame_rate_hz <= 240.0:
            raise UserError(f"frame_rate_hz is {frame_rate_hz:g}; give 10 to 240")
        self.num_ignored = 0
        self._parameters = parameters
        self._frame_rate_hz = frame_rate_hz
        self._look_ahead_s = look_ahead_s
        self._gesture_seed = gesture_seed
        # no curve of the model leaves the hull of the targets; a decay may, and is held there:
        # lips that meet stop
        hull = np.vstack([parameters.target, parameters.neutral])
        self._lowest, self._highest = hull.min(axis=0), hull.max(axis=0)
        self._closes: NDArray[np.bool_] = parameters.closes > 0.0  # (num_visemes, num_mouth_faps)
        self._closing = np.logical_or.reduce(self._closes, axis=1)  # (num_visemes,)
        self.reset()

    def reset(self, start_s: float = 0.0) -> None:
        """Forget the session: rest, the next frame at or after media time ``start_s``."""
        self._phones: dict[int, Phone] = {}
        self._speech_ends_s: list[float] = []
        self._next_index = 0  # after the greatest index seen
        self._first_index = 0  # units before it were flushed
        self._next_frame = math.ceil(start_s * self._frame_rate_hz - 0.01)
        self._time_s = self._next_frame / self._frame_rate_hz  # of the last frame
        self._position = self._parameters.neutral.copy()
        self._slope = np.zeros(NUM_MOUTH_FAPS)
        self._timeline = build_timeline(())
        self._current = self._timeline  # the same as it is seen at the last frame
        self._plan = self._timeline  # the part of it that acts now
        self._acting = b""
        self._changed = False
        self._decay = _NO_DECAY
        self._decay_start_s = 0.0
        self._transition_s = _TRANSITION_S
        self._closed_units: set[int] = set()
        self._late_closures_s: dict[int, float] = {}  # unit index -> its postponed centre
        self._frozen_s = 0.0  # media time stands still for so long: see relax
        self._rest_decay: _Decay | None = None
        self._speaking = False
        self._amplitude = Amplitude(self._parameters.level_db)
        self._gesture = None if self._gesture_seed is None else Gesture(self._gesture_seed)
        self._num_frames = 0  # put out so far; eyes and head move on when media time stands still

    def accept_phone(self, phone: Phone) -> None:
        """Take a new unit, or a revision of one with the same index."""
        times = (phone.onset_s, phone.duration_s)
        if (
            phone.unit not in UNIT_INDEX
            or not all(map(math.isfinite, times))
            or phone.index < self._first_index
        ):
            self.num_ignored += 1
            return
        self._next_index = max(self._next_index, phone.index + 1)
        known = self._phones.get(phone.index)
        if known is not None and known.final and not phone.final:
            return  # an estimate that was overtaken
        self._phones[phone.index] = phone
        self._changed = True

    def accept_speech(self, change: SpeechChange) -> None:
        """Take the beginning or the end of voice activity."""
        self._speaking = change.active
        if not change.active and math.isfinite(change.time_s):
            # whatever was recognised before this was told has ended, be the time ever so early
            began_s = [phone.onset_s for phone in self._phones.values()]
            self._speech_ends_s.append(max([change.time_s, *(s + _BEGUN_S for s in began_s)]))
            self._changed = True
            self._transition_s = _FLUSH_S  # if it is told late

    def accept_level(self, time_s: float, level_db: float) -> None:
        """Take the sound's level around a time: louder speech opens the mouth further."""
        self._amplitude.accept_level(time_s, level_db)

    def advance(self, time_s: float) -> list[FapFrame]:
        """Compute the frames that are due when the sound is known up to ``time_s``.

        Parameters
        ----------
        time_s : float
            Media time, seconds.

        Returns
        -------
        list of (media time in seconds, FAPs (68,) in FAP units)
            All frames up to ``time_s - look_ahead_s`` that were not returned before.
        """
        frames = []
        # a hundredth of a frame forgives rounding of time_s
        last = math.floor((time_s - self._look_ahead_s) * self._frame_rate_hz + 0.01)
        while self._next_frame <= last:
            frames.append(self._compute_frame(self._next_frame / self._frame_rate_hz))
            self._next_frame += 1
        return frames

    def relax(self, num_frames: int) -> list[FapFrame]:
        """Frames that lead to rest while no sound comes and media time stands still.

        All carry the media time of the last frame. When sound comes again `advance` goes on from
        where the face is then.
        """
        if self._rest_decay is None:
            duration_s = REST_S if self._phones else _FLUSH_S
            self._rest_decay = _Decay(
                self._position - self._parameters.neutral,
                self._slope,
                np.full(NUM_MOUTH_FAPS, duration_s),
            )
            self._frozen_s = 0.0
            self._transition_s = _FLUSH_S  # as gently back
        frames = []
        for _ in range(num_frames):
            self._frozen_s += 1.0 / self._frame_rate_hz
            value, slope = self._rest_decay.at(self._frozen_s)
            self._move_to(self._parameters.neutral + value, slope)
            frames.append((self._time_s, self._frame()))
        return frames

    def flush(self) -> None:
        """Interrupt: drop every unit known so far and return to rest within 150 ms."""
        self._phones.clear()
        self._speech_ends_s.clear()
        self._late_closures_s.clear()
        self._closed_units.clear()
        self._first_index = self._next_index
        self._transition_s = _FLUSH_S
        self._rest_decay = None
        self._changed = True

    def _compute_frame(self, time_s: float) -> FapFrame:
        if self._changed:
            self._forget_old_units()
            self._timeline = build_timeline(
                tuple(self._phones.values()), self._speech_ends_s, live=True
            )
        self._current = self._postpone_late_closures(
            self._timeline.go_on(time_s + self._look_ahead_s - _NEWS_S), time_s
        )
        self._plan = self._current.select(around(self._current, time_s, self._look_ahead_s))
        acting = self._plan.unit_index.tobytes() + self._plan.viseme.tobytes()
        if self._changed or acting != self._acting or self._rest_decay is not None:
            self._acting = acting
            self._start_transition()
        value, slope = self._evaluate_plan(time_s)
        rest_value, rest_slope = self._decay.at(time_s - self._decay_start_s)
        self._move_to(value + rest_value, slope + rest_slope)
        self._time_s = time_s
        self._note_closures(time_s)
        return time_s, self._frame()

    def _evaluate_plan(self, time_s: float) -> tuple[Array, Array]:
        """Value and slope of the plan, each (num_mouth_faps,)."""
        step = _SLOPE_STEP_S
        curve = blend(
            self._parameters, self._plan, np.array([time_s - step, time_s, time_s + step])
        )
        return curve[1], (curve[2] - curve[0]) / (2.0 * step)

    def _start_transition(self) -> None:
        """Carry the face over from where it is to the new plan."""
        value, slope = self._evaluate_plan(self._time_s)
        duration_s = np.full(NUM_MOUTH_FAPS, self._transition_s)
        for row in np.flatnonzero(self._closing[self._plan.viseme]):
            if self._plan.centre_end_s[row] > self._time_s:
                left_s = self._plan.centre_start_s[row] - self._time_s
                closes = self._closes[self._plan.viseme[row]]
                duration_s[closes] = np.minimum(
                    duration_s[closes], max(left_s, _SHORTEST_TRANSITION_S)
                )
        self._decay = _Decay(self._position - value, self._slope - slope, duration_s)
        self._decay_start_s = self._time_s
        self._transition_s = _TRANSITION_S
        self._rest_decay = None
        self._changed = False

    def _move_to(self, position: Array, slope: Array) -> None:
        self._position = np.clip(position, self._lowest, self._highest)
        self._slope = np.where(self._position == position, slope, 0.0)

    def _frame(self) -> NDArray[np.float32]:
        faps = np.zeros(NUM_FAPS, dtype=np.float32)
        faps[_MOUTH] = self._position
        self._amplitude.scale(
            faps,
            self._current,
            self._time_s,
            self._time_s + self._look_ahead_s,
            1.0 / self._frame_rate_hz,
        )
        if self._gesture is not None:
            self._gesture.add_to(faps, self._num_frames / self._frame_rate_hz, self._speaking)
        self._num_frames += 1
        return faps

    def _forget_old_units(self) -> None:
        horizon_s = self._time_s - _MEMORY_S
        for index in [i for i, p in self._phones.items() if p.onset_s + p.duration_s < horizon_s]:
            if len(self._phones) > 2:  # what came last may still be held
                del self._phones[index]
                self._closed_units.discard(index)
                self._late_closures_s.pop(index, None)
        self._speech_ends_s = [end_s for end_s in self._speech_ends_s if end_s >= horizon_s]

    def _postpone_late_closures(self, timeline: Timeline, time_s: float) -> Timeline:
        """Move closures that were recognised after their centre to where they can be shown."""
        start_s, end_s = timeline.centre_start_s.copy(), timeline.centre_end_s.copy()
        for row in np.flatnonzero(self._closing[timeline.viseme]):
            unit = int(timeline.unit_index[row])
            if unit in self._closed_units and unit not in self._late_closures_s:
                continue
            late = self._time_s - _LATE_CLOSURE_S < end_s[row] < time_s
            if late and unit not in self._late_closures_s:
                self._late_closures_s[unit] = self._time_s + _CATCH_UP_S
                self._changed = True
            if unit in self._late_closures_s:
                end_s[row] = max(end_s[row], self._late_closures_s[unit])
                start_s[row] = max(start_s[row], min(self._late_closures_s[unit], end_s[row]))
        moved = replace(timeline, centre_start_s=start_s, centre_end_s=end_s)
        return moved.select(np.argsort(start_s, kind="stable"))

    def _note_closures(self, time_s: float) -> None:
        for row in np.flatnonzero(self._closing[self._plan.viseme]):
            if self._plan.centre_start_s[row] - 1.0 / self._frame_rate_hz <= time_s:
                viseme = self._plan.viseme[row]
                error = np.abs(self._position - self._parameters.target[viseme])
                if np.all(error[self._closes[viseme]] < _CLOSED):
                    self._closed_units.add(int(self._plan.unit_index[row]))
