"""Position and velocity of FAPs, and continuous transitions between trajectories."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from kouxing.shared.arrays import Doubles
from kouxing.shared.face.faps import NUM_MOUTH_FAPS
from kouxing.shared.fast_record import Record

TRANSITION_S = 0.04  # duration of the change to a new target trajectory
SLOW_TRANSITION_S = 0.14  # duration after an interruption, and from rest


class FapState(Record, frozen=True):
    """Value and velocity of FAPs at one time."""

    value: Doubles  # FAP units
    velocity: Doubles  # FAP units per second

    def __add__(self, other: FapState) -> FapState:
        return FapState(self.value + other.value, self.velocity + other.velocity)

    def __sub__(self, other: FapState) -> FapState:
        return FapState(self.value - other.value, self.velocity - other.velocity)


def stationary_state(value: Doubles) -> FapState:
    """Return the state of FAPs (num_mouth_faps,) that do not move."""
    return FapState(value, np.zeros(NUM_MOUTH_FAPS))


def clip_state(state: FapState, lowest: Doubles, highest: Doubles) -> FapState:
    """Clip FAPs to their limits. The velocity of a clipped FAP is 0."""
    value = np.minimum(np.maximum(state.value, lowest), highest)
    return FapState(value, np.where(value == state.value, state.velocity, 0.0))


@dataclass(frozen=True, slots=True)
class Transition:
    """Blends two trajectories: their difference decays along a cubic, with one duration per FAP."""

    difference: FapState  # at ``start_s``
    duration_s: Doubles
    start_s: float = 0.0
    longest_s: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "longest_s", float(self.duration_s.max()))

    def at(self, time_s: float) -> FapState:
        """Return the remaining difference."""
        elapsed_s = time_s - self.start_s
        if elapsed_s >= self.longest_s:
            return stationary_state(np.zeros(len(self.duration_s)))
        u = np.minimum(elapsed_s / self.duration_s, 1.0)
        velocity = (1.0 - u) * (
            -6.0 * u * self.difference.value / self.duration_s
            + (1.0 - 3.0 * u) * self.difference.velocity
        )
        return FapState(self.value_at(time_s), velocity)

    def value_at(self, time_s: float) -> Doubles:
        """Return the value of the remaining difference."""
        elapsed_s = time_s - self.start_s
        if elapsed_s >= self.longest_s:
            return np.zeros(len(self.duration_s))
        u, start = np.minimum(elapsed_s / self.duration_s, 1.0), self.difference
        # cubic Hermite spline from (value, velocity) to (0, 0)
        rest: Doubles = (1.0 + 2.0 * u) * start.value + u * self.duration_s * start.velocity
        return (1.0 - u) ** 2 * rest


NO_TRANSITION = Transition(
    stationary_state(np.zeros(NUM_MOUTH_FAPS)), np.ones(NUM_MOUTH_FAPS), -np.inf
)


class RestTransition:
    """Moves the mouth to rest while media time does not advance."""

    def __init__(self, mouth: FapState, neutral: Doubles, duration_s: float) -> None:
        self._neutral = stationary_state(neutral)
        self._transition = Transition(mouth - self._neutral, np.full(NUM_MOUTH_FAPS, duration_s))
        self._elapsed_s = 0.0

    def step(self, step_s: float) -> FapState:
        """Advance by a step; return the mouth."""
        self._elapsed_s += step_s
        return self._neutral + self._transition.at(self._elapsed_s)
