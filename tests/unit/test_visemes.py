"""Units to visemes: table 1 of Li et al. 2011."""

import numpy as np
import pytest

from services.synthesizer.parameters import load_parameters
from services.synthesizer.visemes import (
    CLOSURE_FAPS,
    MOUTH_FAPS,
    REST,
    SHAPES,
    VISEME_INDEX,
    VISEMES,
    shapes_of,
    static_targets,
)
from shared.faps import NUM_FAPS
from shared.phones import INITIALS, SILENCE, UNITS
from tests import heads

pytestmark = pytest.mark.unit


def test_every_unit_has_shapes_that_fill_it() -> None:
    assert set(SHAPES) == set(UNITS)
    for unit in UNITS:
        shapes = shapes_of(unit, None)
        assert all(shape in VISEME_INDEX for shape, _ in shapes)
        assert sum(share for _, share in shapes) == pytest.approx(1.0)
        assert len(shapes) <= 2


def test_every_unit_moves_the_face_by_a_millimetre_or_is_silence() -> None:
    head, target = heads.load("woman"), load_parameters().target
    skin = head.part("skin").vertices

    def moved_mm(shape: str) -> float:
        faps = np.zeros(NUM_FAPS, dtype=np.float32)
        faps[np.array(MOUTH_FAPS) - 1] = target[VISEME_INDEX[shape]]
        return 1e3 * float(np.linalg.norm((head.deform(faps) - head.vertices)[skin], axis=1).max())

    by_shape = {shape: moved_mm(shape) for shape in VISEMES}
    for unit in UNITS:
        moves = max(by_shape[shape] for shape, _ in SHAPES[unit])
        assert moves == 0.0 if unit == SILENCE else moves > 1.0, unit


@pytest.mark.parametrize(
    "group", ["b p m", "f", "d t n", "l", "g k h", "j q x", "zh ch sh r", "z c s"]
)
def test_initials_of_a_group_look_alike(group: str) -> None:
    assert len({shapes_of(unit, "a") for unit in group.split()}) == 1


def test_groups_of_initials_differ() -> None:
    assert len({shapes_of(unit, "a") for unit in INITIALS}) == 8


@pytest.mark.parametrize(
    ("unit", "shapes"),
    [("iao", "i ao"), ("uai", "u ai"), ("iong", "v u"), ("ang", "a"), ("eng", "e"), ("vn", "v ei")],
)
def test_compound_finals_are_split(unit: str, shapes: str) -> None:
    assert [shape for shape, _ in shapes_of(unit, None)] == shapes.split()


def test_initials_round_before_rounded_finals_only() -> None:
    assert shapes_of("d", "u") == shapes_of("t", "uan") == (("d_rounded", 1.0),)
    assert shapes_of("j", "van") == (("j_rounded", 1.0),)
    assert shapes_of("d", "i") == shapes_of("d", None) == (("d", 1.0),)
    assert shapes_of("b", "u") == (("b", 1.0),)  # closed lips have one shape
    assert shapes_of("a", "u") == (("a", 1.0),)


def test_targets_close_the_lips_for_labials_and_open_them_for_vowels() -> None:
    targets = static_targets()
    column = {fap: MOUTH_FAPS.index(fap) for fap in MOUTH_FAPS}
    assert targets.shape == (len(VISEMES), len(MOUTH_FAPS))
    assert not targets[VISEME_INDEX[REST]].any()
    inner = [column[fap] for fap in CLOSURE_FAPS["b"] if fap < 51]
    assert not targets[VISEME_INDEX["b"], inner].any()
    assert targets[VISEME_INDEX["f"], column[5]] == 0.0  # the lower lip at the teeth
    jaw = targets[:, column[3]]
    assert jaw[VISEME_INDEX["a"]] == max(jaw) == 450.0
    width = targets[:, column[6]]
    assert width[VISEME_INDEX["u"]] < 3 * width[VISEME_INDEX["i"]] < 0.0


def test_left_and_right_are_equal() -> None:
    targets = static_targets()
    for left, right in ((6, 7), (8, 9), (10, 11), (12, 13), (53, 54), (55, 56), (57, 58), (59, 60)):
        np.testing.assert_array_equal(
            targets[:, MOUTH_FAPS.index(left)], targets[:, MOUTH_FAPS.index(right)]
        )
