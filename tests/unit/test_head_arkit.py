"""FAPs as ARKit shapes and Oculus visemes, and back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from services.driver.head.head import Head, neutral_faps
from shared.face import blendshapes as arkit
from shared.face.blendshapes import (
    ARKIT,
    ARKIT_NAMES,
    OCULUS_NAMES,
    arkit_faps,
    arkit_weights,
    oculus_weights,
)
from shared.face.faps import FAP_NUMBER, NUM_FAPS
from shared.face.high_level import EXPRESSIONS, VISEMES
from tests import heads

pytestmark = pytest.mark.unit


def weights_by_name(faps: np.ndarray) -> dict[str, float]:
    return dict(zip(ARKIT_NAMES, arkit_weights(faps).tolist(), strict=True))


def test_names_are_apples() -> None:
    assert len(set(ARKIT_NAMES)) == 52
    assert {"jawOpen", "mouthClose", "eyeBlinkLeft", "browInnerUp", "tongueOut"} <= set(ARKIT_NAMES)
    assert len(OCULUS_NAMES) == 15


def test_nothing_from_nothing() -> None:
    rest = np.zeros(NUM_FAPS, np.float32)
    assert not arkit_weights(rest).any()
    np.testing.assert_array_equal(oculus_weights(rest), np.eye(15, dtype=np.float32)[0])


@pytest.mark.parametrize("name", ARKIT_NAMES)
def test_a_shape_is_found_again(name: str) -> None:
    row = ARKIT_NAMES.index(name)
    found = arkit_weights(ARKIT[row])
    assert found.argmax() == row
    assert found[row] > 0.55  # some agree with the sum of others


def test_shapes_add_up() -> None:
    weights = np.zeros(52, np.float32)
    weights[[ARKIT_NAMES.index("jawOpen"), ARKIT_NAMES.index("tongueOut")]] = 0.5, 1.0
    wanted = 0.5 * ARKIT[ARKIT_NAMES.index("jawOpen")] + ARKIT[ARKIT_NAMES.index("tongueOut")]
    np.testing.assert_allclose(arkit_faps(weights), wanted)


def test_left_and_right_mirror_each_other() -> None:
    for name, row in zip(ARKIT_NAMES, ARKIT, strict=True):
        if name.endswith("Left"):
            other = ARKIT[ARKIT_NAMES.index(name.replace("Left", "Right"))]
            assert row[FAP_NUMBER["open_jaw"] - 1] == other[FAP_NUMBER["open_jaw"] - 1]
            left, right = FAP_NUMBER["raise_l_cornerlip"] - 1, FAP_NUMBER["raise_r_cornerlip"] - 1
            assert row[left] == other[right]


def test_single_faps_go_where_they_belong() -> None:
    blink = weights_by_name(neutral_faps(close_t_l_eyelid=1000))
    assert blink["eyeBlinkLeft"] > 0.6
    assert blink["eyeBlinkRight"] < 1e-6
    look = weights_by_name(neutral_faps(yaw_l_eyeball=20_000, yaw_r_eyeball=20_000))
    assert look["eyeLookOutLeft"] == pytest.approx(look["eyeLookInRight"], abs=0.02)
    assert look["eyeLookOutLeft"] > 0.4
    spoken = weights_by_name(VISEMES[10])
    assert spoken["jawOpen"] > 0.4
    assert max(spoken["jawLeft"], spoken["jawRight"]) < 0.01


def test_the_solution_is_the_least_squares_one() -> None:
    system = arkit._ARKIT_SYSTEM
    root = np.linalg.cholesky(system.gram)
    for faps in [*VISEMES, *EXPRESSIONS]:
        right = np.linalg.solve(root, system.right @ faps.astype(float))
        best = lsq_linear(root.T, right, (0, 1 / system.scale), method="bvls").x * system.scale
        np.testing.assert_allclose(arkit_weights(faps), best, atol=0.03)


def test_visemes_are_oculus() -> None:
    for row in range(1, 15):
        found = oculus_weights(VISEMES[row])
        assert found.argmax() == row
        assert found[row] > 0.5


def test_shapes_do_on_the_mesh_what_they_say() -> None:
    head = heads.load("woman")

    def shift(name: str, point: str, *more: str) -> np.ndarray:
        faps = ARKIT[[ARKIT_NAMES.index(shape) for shape in (name, *more)]].sum(axis=0)
        vertex = head.feature_points[point]
        moved: np.ndarray = 1000 * (head.deform(faps) - head.vertices)[vertex]
        return moved

    assert shift("jawOpen", "2.3")[1] < -15
    assert shift("jawOpen", "9.11")[1] < -10  # teeth go with the jaw
    gap = shift("jawOpen", "2.2", "mouthClose") - shift("jawOpen", "2.3", "mouthClose")
    assert abs(gap[1]) < 1  # the lips meet although the jaw is open
    assert shift("mouthSmileLeft", "2.4")[1] > 5
    assert abs(shift("mouthSmileLeft", "2.5")[1]) < 1
    assert shift("mouthPucker", "2.2")[2] > 5
    assert shift("eyeBlinkLeft", "3.1")[1] < -5
    assert shift("browInnerUp", "4.1")[1] > 0.5
    assert shift("tongueOut", "6.1")[2] > 20
    assert shift("eyeLookUpLeft", "3.5")[1] > 1


def test_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(68,\)"):
        arkit_weights(np.zeros(52, np.float32))


def test_all_shapes_keep_the_head_whole() -> None:
    head: Head = heads.load("woman", "coarse")
    for row in ARKIT:
        assert np.isfinite(head.deform(row)).all()
