"""Dominance functions: Li et al. 2011, eq. 5-7; Wang & Cai 2003, eq. 7."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.dominance import (
    log_closure,
    log_dominance,
    log_left_silence,
    log_pause,
    log_right_silence,
)

pytestmark = pytest.mark.unit


def array(*values: float) -> NDArray[np.float64]:
    return np.array(values)


def test_viseme_matches_a_manual_calculation() -> None:
    # alpha 2, theta 3 before the apex and 5 after it, c 1.5
    got = np.exp(log_dominance(array(0.25, 0.0, -0.25), array(2.0), array(3.0), array(5.0), 1.5))
    want = [2.0 * math.exp(-3.0 * 0.125), 2.0, 2.0 * math.exp(-5.0 * 0.125)]
    np.testing.assert_allclose(got, want)


@pytest.mark.parametrize(("model", "sign"), [(log_left_silence, 1.0), (log_right_silence, -1.0)])
def test_silence_falls_or_grows_with_time(
    model: Callable[..., NDArray[np.float64]], sign: float
) -> None:
    # sigma = t_l - t: positive before the apex
    got = np.exp(model(array(0.25, 0.0, -0.25), array(2.0), array(3.0), 1.5))
    np.testing.assert_allclose(got, 2.0 * np.exp(sign * array(0.375, 0.0, -0.375)))


def test_log_weights_are_finite_far_away() -> None:
    far, one = array(1e6, -1e6), array(1.0)
    for weights in (
        log_dominance(far, one, 40.0 * one, 40.0 * one, 1.3),
        log_left_silence(far, one, 40.0 * one, 1.3),
        log_right_silence(far, one, 40.0 * one, 1.3),
    ):
        assert np.isfinite(weights).all()


def test_silence_vanishes_between_touching_phones() -> None:
    strength = [float(log_pause(array(0.0), array(0.0), array(s))[0]) for s in (1e-6, 0.05, 0.5)]
    assert strength[0] < -10.0 < strength[1] < strength[2]
    # the intersection is never above the lower model
    assert float(log_pause(array(3.0), array(-2.0), array(1.0))[0]) <= -2.0


def test_closure_has_the_ends_of_wang_and_cai_eq_7() -> None:
    viseme, others = array(-1.0, -1.0, -1.0), array(2.0, 2.0, 2.0)
    got = log_closure(viseme, others, array(0.07, 0.0, -0.2), reach_s=0.07, closure_ratio=25.0)
    np.testing.assert_allclose(got, [-1.0, math.log(25.0) + 2.0, -1.0])
