"""Transitions are continuous in value and velocity, with one duration per FAP."""

import numpy as np
import pytest

from kouxing.services.synthesizer.lips.dynamic_visemes.target_trajectory import TargetTrajectory
from kouxing.services.synthesizer.lips.trajectory import FapState, RestTransition, Transition, still
from kouxing.shared.face.faps import MOUTH_FAPS
from tests.lips import LIPS, articulation_of, utterance

pytestmark = pytest.mark.unit

NUM = len(MOUTH_FAPS)
DIFFERENCE = FapState(np.linspace(-100.0, 100.0, NUM), np.linspace(500.0, -500.0, NUM))
DURATION_S = np.linspace(0.02, 0.14, NUM)


def test_transition_ends_at_zero_value_and_velocity() -> None:
    transition = Transition(DIFFERENCE, DURATION_S)
    begin, end = transition.at(0.0), transition.at(0.14)
    np.testing.assert_allclose(begin.value, DIFFERENCE.value)
    np.testing.assert_allclose(begin.velocity, DIFFERENCE.velocity)
    assert not end.value.any()
    assert not end.velocity.any()
    done = transition.at(0.05)
    assert ((done.value == 0.0) == (DURATION_S <= 0.05)).all()


@pytest.mark.parametrize("time_s", [0.005, 0.0199, 0.06])
def test_transition_velocity_is_the_derivative_of_its_value(time_s: float) -> None:
    transition, step_s = Transition(DIFFERENCE, DURATION_S), 1e-7
    before, after = transition.at(time_s - step_s), transition.at(time_s + step_s)
    slope = (after.value - before.value) / (2.0 * step_s)
    np.testing.assert_allclose(transition.at(time_s).velocity, slope, atol=0.05)


def test_target_velocity_is_the_derivative_of_its_value() -> None:
    trajectory = TargetTrajectory(LIPS.parameters, articulation_of(utterance(2, 8)).timeline)
    times = np.arange(0.4, 0.9, 0.001)
    values = np.array([trajectory.at(time_s).value for time_s in times])
    slopes = np.array([trajectory.at(time_s).velocity for time_s in times])
    assert np.abs(slopes).max() > 100.0
    inside = slice(1, -1)
    np.testing.assert_allclose(
        slopes[inside], np.gradient(values, times, axis=0)[inside], rtol=1e-6, atol=1e-3
    )


def test_rest_transition_ends_at_the_neutral_mouth() -> None:
    neutral = np.full(NUM, 7.0)
    rest = RestTransition(still(neutral) + DIFFERENCE, neutral, duration_s=0.3)
    mouths = [rest.step(0.02) for _ in range(16)]
    assert np.abs(mouths[0].value - neutral - DIFFERENCE.value).max() < 15.0
    np.testing.assert_allclose(mouths[-1].value, neutral)
    assert not mouths[-1].velocity.any()
