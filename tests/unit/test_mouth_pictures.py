"""The mouths of the built-in heads: visemes, differences in pictures, and light on the teeth."""

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer, mouth_light
from kouxing.services.driver.render.scene import place_camera
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.dynamic_visemes import visemes
from kouxing.services.synthesizer.modifiers.expressiveness import scale_mouth
from kouxing.shared.face import high_level_faps
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from tests import heads
from tests.lips import viseme_faps

VISEMES = "a i u o e v f b".split()
SIZE_PX = (640, 480)
MIN_PIXELS = 300  # pixels that differ between two mouths,
MIN_CHANGE = 0.13  # each by this share of the region's mean brightness


def spoken(viseme: str) -> NDArray[np.float32]:
    """FAPs (68,) of a viseme's target as the services send it by default."""
    faps = viseme_faps(viseme)
    scale_mouth(faps, SynthesizerConfig().expressiveness)
    return faps


@pytest.fixture(scope="module", params=heads.NAMES)
def coarse_head(request: pytest.FixtureRequest) -> Head:
    name: str = request.param
    return heads.load(name, "coarse")


def test_any_two_mouths_differ(coarse_head: Head) -> None:
    renderer = Renderer(coarse_head, *SIZE_PX, samples=0, camera=place_camera(coarse_head))
    pictures = {viseme: renderer.draw(spoken(viseme)).astype(np.int32) for viseme in VISEMES}
    renderer.close()
    for first, second in combinations(VISEMES, 2):
        change = np.abs(pictures[first] - pictures[second])[240:420, 220:420].max(axis=2)
        brightness = pictures[first][240:420, 220:420].max(axis=2).mean()
        assert (change > MIN_CHANGE * brightness).sum() > MIN_PIXELS, (first, second)


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


def read_visemes() -> dict[str, NDArray[np.float32]]:
    faps = np.zeros((len(visemes.VISEMES), NUM_FAPS), np.float32)
    faps[:, np.array(MOUTH_FAPS) - 1] = visemes.static_targets()
    return dict(zip(visemes.VISEMES, faps, strict=True))


VISEME_FAPS = read_visemes()
PAIRS = (("2.2", "2.3"), ("2.6", "2.8"), ("2.7", "2.9"))


@pytest.fixture(scope="module", params=heads.NAMES)
def head(request: pytest.FixtureRequest) -> Head:
    name: str = request.param
    return heads.load(name)


def place_mm(head: Head, faps: NDArray[np.float32], *points: str) -> NDArray[np.float64]:
    """Return feature point positions, mm."""
    places = head.deform(faps)[[head.feature_points[point] for point in points]]
    return 1000 * places.astype(np.float64)


def gaps_mm(head: Head, faps: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the mouth opening in the middle and halfway to both corners, mm."""
    places = place_mm(head, faps, *(point for pair in PAIRS for point in pair))
    return places[::2, 1] - places[1::2, 1]


def test_lips_do_not_cross_and_close_in_b_p_m(head: Head) -> None:
    assert gaps_mm(head, VISEME_FAPS["b"]).max() <= 0.1
    for name, faps in VISEME_FAPS.items():
        assert gaps_mm(head, faps).min() > -0.7, name  # at rest they overlap by 0.4 mm


@pytest.mark.parametrize("name", ["u", "v"])
def test_u_is_rounded_and_protruded(head: Head, name: str) -> None:
    points = ("2.4", "2.5", "2.2", "2.3")
    rest, rounded = (place_mm(head, VISEME_FAPS[shape], *points) for shape in ("rest", name))
    assert rounded[0, 0] - rounded[1, 0] < 0.72 * (rest[0, 0] - rest[1, 0])
    assert (rounded - rest)[2:, 2].min() > 1.4


@pytest.mark.parametrize("faps", [VISEME_FAPS["f"], high_level_faps.viseme_faps(2, 0, 63)])
def test_lower_lip_meets_the_upper_teeth_in_f(head: Head, faps: NDArray[np.float32]) -> None:
    upper_lip, lower_lip, edge = place_mm(head, faps, "2.2", "2.3", "9.10")[:, 1]
    assert -0.5 < lower_lip - edge < 2.0  # it covers the cutting edge,
    assert upper_lip - lower_lip > 1.0  # and the teeth show above it
