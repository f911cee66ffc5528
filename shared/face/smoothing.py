"""Smoothing of values over time."""

import math
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", float, NDArray[np.float32])


def smoothing_share(elapsed_s: float, time_constant_s: float) -> float:
    """Return the fraction of a change that a one-pole low-pass filter makes in a time, 0 to 1."""
    return -math.expm1(-elapsed_s / time_constant_s)


def smooth_step(share: float) -> float:
    """Map 0 to 1 onto 0 to 1 with a slope of 0 at both ends; other values are clipped."""
    share = min(max(share, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


class TwoPoleFilter(Generic[Value]):
    """Two one-pole low-pass filters in series: the output has no corners."""

    def __init__(self, value: Value) -> None:
        self._halfway: Value = value
        self.value: Value = value

    def step(self, goal: Value, step_s: float, time_constant_s: float) -> Value:
        """Move towards a goal for ``step_s`` seconds; return the new value."""
        share = smoothing_share(step_s, time_constant_s)
        self._halfway = self._halfway + share * (goal - self._halfway)
        self.value = self.value + share * (self._halfway - self.value)
        return self.value
