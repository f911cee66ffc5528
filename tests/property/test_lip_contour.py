"""The Ferguson contour has no "sick shapes" (Zhang et al. 2021, section 6.2) at any opening R."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.ferguson.contour import (
    LINES,
    LipLine,
    build_lip_lines,
    contour,
    load_lip_points,
    opening_to_faps,
)
from kouxing.services.synthesizer.lips.ferguson.key_frames import KeyFrames
from kouxing.shared.face.faps import FAPS, MOUTH_FAPS

OPENINGS = st.lists(st.floats(0.0, 5.0), min_size=1, max_size=20)
KEY_FRAMES = st.lists(st.tuples(st.floats(0.02, 1.0), st.floats(0.0, 5.0)), min_size=1, max_size=12)
MAX_CURVATURE = 5.0  # 1 / mouth width: a radius of 9 mm
STRAIGHT = 0.2  # curvature below which an edge counts as straight
MAX_INFLECTIONS = 2  # per edge: a dent between two bumps


def sample(line: LipLine) -> NDArray[np.float64]:
    return np.linspace(float(line.closed.x[0]), float(line.closed.x[-1]), 201)


def assert_no_sick_shape(openings: Sequence[float] | NDArray[np.float64]) -> None:
    """Check that lips do not cross and edges do not bend sharply or have more than one dent."""
    opening = np.asarray(openings, float)
    x = sample(build_lip_lines()["inner upper"])
    heights = np.stack([build_lip_lines()[name].heights(x, opening) for name in LINES])
    outer_upper, inner_upper, inner_lower, outer_lower = heights
    assert (inner_upper - inner_lower >= -1e-9).all()
    assert (outer_upper > inner_upper).all()
    assert (inner_lower > outer_lower).all()
    for line in build_lip_lines().values():
        x = sample(line)
        slope, bend = (
            line.closed(x, order) + opening[:, None] * line.travel(x, order) for order in (1, 2)
        )
        for curvature in bend / (1.0 + slope**2) ** 1.5:
            assert np.abs(curvature).max() <= MAX_CURVATURE
            side = np.sign(curvature[np.abs(curvature) > STRAIGHT])
            assert (side[1:] != side[:-1]).sum() <= MAX_INFLECTIONS


@given(openings=OPENINGS)
def test_no_opening_has_a_sick_shape(openings: list[float]) -> None:
    assert_no_sick_shape(openings)


@given(steps=KEY_FRAMES)
def test_the_contour_moves_without_jumps(steps: list[tuple[float, float]]) -> None:
    times_s = np.cumsum([length_s for length_s, _ in steps])
    motion = KeyFrames(times_s, np.array([opening for _, opening in steps]))
    moments_s = np.arange(-0.1, times_s[-1] + 0.1, 0.005)
    openings = motion.openings_at(moments_s)
    assert_no_sick_shape(openings[::50])
    # maximum lower-lip travel between key frames 20 ms apart
    leap = np.abs(np.diff(contour(openings, 5)[..., 1], axis=0)).max(initial=0.0)
    assert leap <= 0.22 * 0.005 / 0.02


@given(opening=st.floats(0.0, 5.0))
def test_feature_points_travel_as_measured(opening: float) -> None:
    lines, points = build_lip_lines(), load_lip_points()
    faps = dict(zip(MOUTH_FAPS, opening_to_faps([opening])[0], strict=True))
    for name, members in LINES.items():
        for member in members:
            point = points[member]
            assert point.fap is not None
            assert member in FAPS[point.fap - 1].feature_points
            sign = 1.0 if FAPS[point.fap - 1].direction == "up" else -1.0
            rise = sign * faps[point.fap] * 0.39 / 1024.0  # mouth widths
            height = lines[name].heights([point.x], [opening])[0, 0]
            assert height == pytest.approx(point.y + rise, abs=1e-6)
