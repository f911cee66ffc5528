"""Measures of curves with known results."""

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.evaluation.lips.measures import Detections, closures, is_closed_at

TIME_S = np.arange(0.0, 4.0, 0.02)


def mouth(*closed: tuple[float, float], opening: float = 300.0) -> NDArray[np.float64]:
    """Open, but for some spans of time that are shut, a frame's slope each side."""
    curve = np.full(len(TIME_S), opening)
    for start_s, end_s in closed:
        curve[(start_s - 1e-6 <= TIME_S) & (end_s + 1e-6 >= TIME_S)] = 0.0
    return curve


def test_counts_missed_and_false_closures() -> None:
    real_s = np.array([0.5, 1.5, 2.5])
    made = mouth((0.54, 0.56), (2.0, 2.1), (2.4, 2.46), (3.5, 3.5))
    hits = closures(real_s, real_s, TIME_S, made)
    assert hits == Detections(real=3, met=2, made=4, true=2)
    assert hits.recall == pytest.approx(2 / 3)
    assert hits.precision == 0.5
    assert hits.f1 == pytest.approx(4 / 7)
    np.testing.assert_array_equal(is_closed_at(real_s, TIME_S, made), [True, False, True])
    assert (hits + hits).f1 == hits.f1
    assert hits + hits == Detections(6, 4, 8, 4)
