"""Accuracy of made lips compared with real ones (Zhang et al. 2021, section 6)."""

import numpy as np
import pytest

from kouxing.evaluation.lips.speaking_rates import accuracy_of
from kouxing.services.synthesizer.lips.ferguson.contour import faps_of
from kouxing.shared.face.faps import MOUTH_FAPS


def test_accuracy_is_one_minus_the_relative_error_of_the_measured_heights() -> None:
    real = faps_of(np.array([0.0, 1.0, 2.0, 4.0, 5.0, 3.0]))
    assert accuracy_of(real, real) == pytest.approx(1.0)
    assert accuracy_of(-real, real) == pytest.approx(-1.0)
    made = 0.75 * real
    real[2] = np.nan
    real[:, MOUTH_FAPS.index(52)] = np.nan
    made[:, MOUTH_FAPS.index(3)] = 1e4  # the jaw is no lip
    made[:, MOUTH_FAPS.index(6)] = 1e4  # the paper moves lips vertically
    assert accuracy_of(made, real) == pytest.approx(0.75)
