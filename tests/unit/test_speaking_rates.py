"""Accuracy of made lips compared with real ones (Zhang et al. 2021, section 6)."""

from __future__ import annotations

import numpy as np
import pytest

from kouxing.evaluation.lips.speaking_rates import (
    accuracy_of,
)
from kouxing.services.synthesizer.lips.ferguson.contour import faps_of
from kouxing.shared.face.faps import MOUTH_FAPS

OPENINGS = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 3.0])


def test_accuracy_is_one_minus_the_relative_error() -> None:
    real = faps_of(OPENINGS)
    assert accuracy_of(real, real) == pytest.approx(1.0)
    assert accuracy_of(0.75 * real, real) == pytest.approx(0.75)
    assert accuracy_of(np.zeros_like(real), real) == pytest.approx(0.0)
    assert accuracy_of(-real, real) == pytest.approx(-1.0)


def test_accuracy_ignores_unmeasured_points_and_other_faps() -> None:
    real = faps_of(OPENINGS)
    made = 0.5 * real
    real[2] = np.nan
    real[:, MOUTH_FAPS.index(52)] = np.nan
    made[:, MOUTH_FAPS.index(3)] = 1e4  # the jaw is no lip
    made[:, MOUTH_FAPS.index(6)] = 1e4  # the paper moves lips vertically
    assert accuracy_of(made, real) == pytest.approx(0.5)
