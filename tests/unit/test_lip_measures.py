"""Measures of curves with known results."""

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.evaluation.lips.measures import (
    Detections,
    Moments,
    best_lag,
    closures,
    is_closed_at,
    moments,
    real_closed,
    real_closures,
)

TIME_S = np.arange(0.0, 4.0, 0.02)


def mouth(*closed: tuple[float, float], opening: float = 300.0) -> NDArray[np.float64]:
    """Open, but for some spans of time that are shut, a frame's slope each side."""
    curve = np.full(len(TIME_S), opening)
    for start_s, end_s in closed:
        curve[(start_s - 1e-6 <= TIME_S) & (end_s + 1e-6 >= TIME_S)] = 0.0
    return curve


def test_moments_add_up() -> None:
    real = np.array([0.0, 1.0, 2.0, 3.0])
    assert moments(2.0 * real + 7.0, real).correlation == pytest.approx(1.0)
    assert moments(-real, real).correlation == pytest.approx(-1.0)
    assert moments(np.ones(4), real).correlation is None
    # a constant offset is no error; the deviations -1.5 to 1.5 are doubled
    assert moments(2.0 * real + 7.0, real).rmse == pytest.approx(np.sqrt(1.25))
    both = moments(real, real) + moments(-real, real)
    assert both.num_frames == 8
    assert both.correlation == pytest.approx(0.0)
    assert moments(np.zeros(0), np.zeros(0)) == Moments()
    assert Moments().correlation is Moments().rmse is None


def test_finds_the_lag_of_a_delayed_curve() -> None:
    real = np.sin(2.0 * np.pi * TIME_S)
    lags_s = np.arange(-5, 6) / 50.0
    late = [moments(np.sin(2.0 * np.pi * (TIME_S + lag_s - 0.06)), real) for lag_s in lags_s]
    assert best_lag(late, lags_s) == pytest.approx((1.0, 0.06))
    assert best_lag(late[:8], lags_s[:8]) is None  # it may be better still beyond
    assert best_lag([Moments()] * len(lags_s), lags_s) is best_lag([], lags_s) is None


def test_real_closures_are_minima_near_an_opening() -> None:
    curve = mouth((1.0, 1.0), (2.0, 3.0))
    # a rest of a second counts at its end: its other frames are not a minimum
    np.testing.assert_allclose(real_closures(TIME_S, curve), [1.0, 3.0])
    curve[(TIME_S > 0.9) & (TIME_S < 1.1)] = np.nan
    np.testing.assert_allclose(real_closures(TIME_S, curve), [3.0])
    half_shut = mouth((3.0, 3.2))
    half_shut[50] = 150.0
    np.testing.assert_allclose(real_closures(TIME_S, half_shut), [3.2])
    assert not len(real_closures(TIME_S, np.full(len(TIME_S), np.nan)))
    assert not len(real_closed(TIME_S, np.full(len(TIME_S), np.nan)))


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
