"""FAP 1 and FAP 2."""

from __future__ import annotations

import numpy as np
import pytest

from kouxing.services.driver.head.head import Head
from kouxing.shared.errors import UserError
from kouxing.shared.face.high_level import (
    VISEMES,
    expression_faps,
    viseme_faps,
)

pytestmark = pytest.mark.unit


def test_blend() -> None:
    np.testing.assert_array_equal(viseme_faps(1, 10, 63), VISEMES[1])
    np.testing.assert_array_equal(viseme_faps(1, 10, 0), VISEMES[10])
    np.testing.assert_allclose(
        viseme_faps(1, 10, 21), VISEMES[1] / 3 + VISEMES[10] * 2 / 3, rtol=1e-5
    )


def test_visemes_and_expressions_move_the_face() -> None:
    head = Head.load(detail="coarse")
    lower = head.feature_points["2.3"]
    assert head.deform(viseme_faps(10, 0, 63))[lower, 1] < head.vertices[lower, 1] - 0.008
    corner = head.feature_points["8.3"]
    assert head.deform(expression_faps(1, 63))[corner, 1] > head.vertices[corner, 1] + 0.004


@pytest.mark.parametrize("select", [-1, 15])
def test_unknown_viseme(select: int) -> None:
    with pytest.raises(UserError, match="viseme_select"):
        viseme_faps(select, 0, 63)


def test_rejects_excessive_intensity() -> None:
    with pytest.raises(UserError, match="expression_intensity"):
        expression_faps(1, 64)
