"""Mouths can be distinguished in pictures; light on teeth and tongue."""

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer, mouth_light
from kouxing.services.driver.render.scene import camera
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.modifiers.expressiveness import Expressiveness
from tests import heads
from tests.lips import viseme_faps

VISEMES = "a i u o e v f b".split()
SIZE_PX = (640, 480)
MIN_PIXELS = 300  # pixels that differ between two mouths,
MIN_CHANGE = 0.13  # each by this share of the region's mean brightness


def spoken(viseme: str) -> NDArray[np.float32]:
    """FAPs (68,) of a viseme's target as the services send it by default."""
    faps = viseme_faps(viseme)
    Expressiveness(SynthesizerConfig().expressiveness).apply(faps)
    return faps


@pytest.fixture(scope="module", params=heads.NAMES)
def head(request: pytest.FixtureRequest) -> Head:
    name: str = request.param
    return heads.load(name, "coarse")


def test_any_two_mouths_differ(head: Head) -> None:
    renderer = Renderer(head, *SIZE_PX, samples=0, camera=camera(head))
    pictures = {viseme: renderer.draw(spoken(viseme)).astype(np.int32) for viseme in VISEMES}
    renderer.close()
    for one, other in combinations(VISEMES, 2):
        change = np.abs(pictures[one] - pictures[other])[240:420, 220:420].max(axis=2)
        brightness = pictures[one][240:420, 220:420].max(axis=2).mean()
        assert (change > MIN_CHANGE * brightness).sum() > MIN_PIXELS, (one, other)


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
