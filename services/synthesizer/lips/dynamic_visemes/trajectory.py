"""Where the mouth is to be, and how it gets there from another trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.blending import blend
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import (
    NUM_MOUTH_FAPS,
    VisemeParameters,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline

Array = NDArray[np.float64]

_SLOPE_STEP_S = 1e-3


@dataclass(frozen=True, slots=True)
class Motion:
    """Value and slope of all mouth FAPs at one time."""

    value: Array  # (num_mouth_faps,) FAP units
    slope: Array  # (num_mouth_faps,) FAP units per second

    def __add__(self, other: Motion) -> Motion:
        return Motion(self.value + other.value, self.slope + other.slope)

    def __sub__(self, other: Motion) -> Motion:
        return Motion(self.value - other.value, self.slope - other.slope)


def motionless(value: Array) -> Motion:
    """Return a mouth that stands still, from its FAPs (num_mouth_faps,)."""
    return Motion(value, np.zeros(NUM_MOUTH_FAPS))


@dataclass(frozen=True, slots=True)
class TargetTrajectory:
    """The curve that a timeline of visemes asks for."""

    parameters: VisemeParameters
    timeline: Timeline

    def at(self, time_s: float) -> Motion:
        """Return the motion at a media time."""
        step = _SLOPE_STEP_S
        times = np.array([time_s - step, time_s, time_s + step])
        before, here, after = blend(self.parameters, self.timeline, times)
        return Motion(here, (after - before) / (2.0 * step))


@dataclass(frozen=True, slots=True)
class Transition:
    """A difference between two trajectories, led to zero along a cubic: each FAP in its own time.

    Added to the new trajectory, it keeps the mouth continuous in position and velocity.
    """

    difference: Motion
    duration_s: Array  # (num_mouth_faps,)

    def at(self, elapsed_s: float) -> Motion:
        """Return what is left of the difference after ``elapsed_s``."""
        u = np.minimum(elapsed_s / self.duration_s, 1.0)
        start, duration_s = self.difference, self.duration_s
        # cubic Hermite spline from (value, slope) to (0, 0)
        value = (1.0 - u) ** 2 * ((1.0 + 2.0 * u) * start.value + u * duration_s * start.slope)
        slope = (1.0 - u) * (-6.0 * u * start.value / duration_s + (1.0 - 3.0 * u) * start.slope)
        return Motion(value, slope)


NO_TRANSITION = Transition(motionless(np.zeros(NUM_MOUTH_FAPS)), np.ones(NUM_MOUTH_FAPS))


class Rest:
    """The way to rest while media time stands still."""

    def __init__(self, mouth: Motion, neutral: Array, duration_s: float) -> None:
        self._neutral = motionless(neutral)
        self._transition = Transition(mouth - self._neutral, np.full(NUM_MOUTH_FAPS, duration_s))
        self._elapsed_s = 0.0

    def step(self, step_s: float) -> Motion:
        """Go on by a step; return the mouth then."""
        self._elapsed_s += step_s
        return self._neutral + self._transition.at(self._elapsed_s)
