"""The mouths of the built-in heads in all visemes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.driver.head.head import Head
from kouxing.services.synthesizer.lips.dynamic_visemes import visemes
from kouxing.shared.face import high_level
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from tests import heads


def read_visemes() -> dict[str, NDArray[np.float32]]:
    faps = np.zeros((len(visemes.VISEMES), NUM_FAPS), np.float32)
    faps[:, np.array(MOUTH_FAPS) - 1] = visemes.static_targets()
    return dict(zip(visemes.VISEMES, faps, strict=True))


VISEMES = read_visemes()
INNER_PARTS = ("teeth_upper", "teeth_lower", "tongue")
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


def depth_mm(points: NDArray[np.float32], surface: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how far points (N, 3) are in front of triangles (F, 3, 3).

    The result is -1000 for points that no triangle covers.
    """
    a, b, c = surface.astype(np.float64).transpose(1, 0, 2)
    ab, ac = (b - a)[:, :2], (c - a)[:, :2]
    area = ab[:, 0] * ac[:, 1] - ac[:, 0] * ab[:, 1]
    faces_front = area > 1e-10
    a, b, c, ab, ac = (rows[faces_front] for rows in (a, b, c, ab, ac))
    ap = points[:, None, :2] - a[:, :2]  # (N, F, 2)
    v = (ap[..., 0] * ac[:, 1] - ac[:, 0] * ap[..., 1]) / area[faces_front]
    w = (ab[:, 0] * ap[..., 1] - ap[..., 0] * ab[:, 1]) / area[faces_front]
    covers = (v >= 0) & (w >= 0) & (v + w <= 1)
    z = a[:, 2] + v * (b - a)[:, 2] + w * (c - a)[:, 2]
    front = np.where(covers, z, -np.inf).max(axis=1)
    return np.where(np.isfinite(front), 1000 * (points[:, 2] - front), -1000.0)


def lips(head: Head) -> NDArray[np.uint32]:
    """Return the triangles (F, 3) of the outer skin around the mouth."""
    triangles = head.triangles[head.part("skin").triangles]
    middle = head.vertices[triangles].mean(axis=1)
    corners = head.vertices[[head.feature_points[f"8.{n}"] for n in range(1, 5)]]
    low, high = corners.min(axis=0), corners.max(axis=0)
    near = (np.abs(middle[:, 0]) < 1.1 * high[0]) & (middle[:, 2] > low[2] - 0.01)
    near &= (middle[:, 1] > low[1] - 0.012) & (middle[:, 1] < high[1] + 0.008)
    nearby: NDArray[np.uint32] = triangles[near]
    return nearby


def test_lips_do_not_cross_and_close_in_b_p_m(head: Head) -> None:
    assert gaps_mm(head, VISEMES["b"]).max() <= 0.1
    for name, faps in VISEMES.items():
        assert gaps_mm(head, faps).min() > -0.7, name  # at rest they overlap by 0.4 mm


@pytest.mark.parametrize("name", ["u", "v"])
def test_u_is_rounded_and_protruded(head: Head, name: str) -> None:
    points = ("2.4", "2.5", "2.2", "2.3")
    rest, rounded = (place_mm(head, VISEMES[shape], *points) for shape in ("rest", name))
    assert rounded[0, 0] - rounded[1, 0] < 0.72 * (rest[0, 0] - rest[1, 0])
    assert (rounded - rest)[2:, 2].min() > 1.4


@pytest.mark.parametrize("faps", [VISEMES["f"], high_level.viseme_faps(2, 0, 63)])
def test_lower_lip_meets_the_upper_teeth_in_f(head: Head, faps: NDArray[np.float32]) -> None:
    upper_lip, lower_lip, edge = place_mm(head, faps, "2.2", "2.3", "9.10")[:, 1]
    assert -0.5 < lower_lip - edge < 2.0  # it covers the cutting edge,
    assert upper_lip - lower_lip > 1.0  # and the teeth show above it


def test_nothing_penetrates_the_skin(head: Head) -> None:
    """Teeth and tongue stay behind lips and chin."""
    head = heads.load(head.name, "coarse")  # the coarse skin is closer to the teeth
    around = lips(head)
    spoken = [*VISEMES.values(), *high_level.VISEMES, *high_level.EXPRESSIONS]
    for number, faps in enumerate(spoken):
        vertices = head.deform(faps)
        parts = [vertices[head.part(part).vertices][::4] for part in INNER_PARTS]
        inside = np.concatenate(parts)
        inside = inside[inside[:, 2] > np.quantile(inside[:, 2], 0.6)]  # front vertices
        assert depth_mm(inside, vertices[around]).max() < 0.2, number
