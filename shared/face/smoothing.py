"""Smooths values over time."""

import math
from typing import Generic, TypeVar

from kouxing.shared.arrays import Floats

Value = TypeVar("Value", float, Floats)


def smoothing_gain(elapsed_s: float, time_constant_s: float) -> float:
    """Return the gain of a one-pole low-pass filter over a time step, 0 to 1."""
    return -math.expm1(-elapsed_s / time_constant_s)


def smooth_step(x: float) -> float:
    """Map 0 to 1 onto 0 to 1 with a slope of 0 at both ends; other values are clipped."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


class TwoPoleFilter(Generic[Value]):
    """Two one-pole low-pass filters in series, so that the output has no corners."""

    def __init__(self, value: Value) -> None:
        self._halfway: Value = value
        self.value: Value = value

    def step(self, goal: Value, step_s: float, time_constant_s: float) -> Value:
        """Move toward a goal for ``step_s`` seconds; return the new value."""
        gain = smoothing_gain(step_s, time_constant_s)
        self._halfway = self._halfway + gain * (goal - self._halfway)
        self.value = self.value + gain * (self._halfway - self.value)
        return self.value
