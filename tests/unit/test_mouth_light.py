"""Light on teeth and tongue."""

import numpy as np
import pytest

from kouxing.services.driver.render.renderer import mouth_light


# same values as in tests/page/mouth-light.test.mjs
@pytest.mark.parametrize(
    ("upper", "lower", "pushed", "light"),
    [(0, 0, 0, 0.08), (0, -120, 0, 0.5698), (-20, -120, 260, 0.4065), (-280, -600, 70, 0.9242)],
)
def test_small_mouths_and_protruding_lips_admit_little_light(
    upper: float, lower: float, pushed: float, light: float
) -> None:
    faps = np.zeros(68, np.float32)
    faps[[3, 4, 15, 16]] = upper, lower, pushed, pushed
    assert mouth_light(faps) == pytest.approx(light, abs=1e-4)
