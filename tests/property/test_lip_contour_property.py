"""No "sick shapes" (Zhang et al. 2021, section 6.2): whatever R does, lips stay lips."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kouxing.evaluation.lips.contour_shapes import check_shapes
from kouxing.services.synthesizer.lips.ferguson.contour import contour
from kouxing.services.synthesizer.lips.ferguson.motion import KeyFrames

pytestmark = pytest.mark.property

OPENINGS = st.lists(st.floats(0.0, 5.0), min_size=1, max_size=20)
KEY_FRAMES = st.lists(st.tuples(st.floats(0.02, 1.0), st.floats(0.0, 5.0)), min_size=1, max_size=12)


@given(openings=OPENINGS, num_points=st.integers(2, 200))
def test_any_opening_and_any_number_of_points_has_a_sound_shape(
    openings: list[float], num_points: int
) -> None:
    points = contour(openings, num_points)
    outer_upper, inner_upper, inner_lower, outer_lower = (points[:, row, :, 1] for row in range(4))
    assert (inner_upper >= inner_lower - 1e-9).all()
    assert (outer_upper >= outer_lower - 1e-9).all()
    assert not len(check_shapes(openings).faults)


@given(openings=OPENINGS, num_points=st.integers(2, 60))
def test_more_points_lie_on_the_same_curve(openings: list[float], num_points: int) -> None:
    few = contour(openings, num_points)
    many = contour(openings, 2 * num_points - 1)
    assert np.allclose(few, many[:, :, ::2])


@given(steps=KEY_FRAMES, smooth=st.booleans())
def test_key_frames_move_lips_without_leaps(steps: list[tuple[float, float]], smooth: bool) -> None:
    times_s = np.cumsum([length_s for length_s, _ in steps])
    motion = KeyFrames(times_s, np.array([opening for _, opening in steps]))
    moments_s = np.arange(-0.1, times_s[-1] + 0.1, 0.005)
    openings = motion.openings_at(moments_s, smooth=smooth)
    assert not len(check_shapes(openings[::50]).faults)
    # the lower lip's travel, at most, between key frames 20 ms apart; a smooth curve's slope is
    # up to three times a line's
    leap = np.abs(np.diff(contour(openings, 5)[..., 1], axis=0)).max(initial=0.0)
    assert leap <= 0.22 * 3.0 * 0.005 / 0.02
