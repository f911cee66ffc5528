"""Conversion between FAPs and weights of ARKit, Oculus and VRM shapes."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.high_level import EXPRESSIONS, VISEMES
from kouxing.shared.face.idle_motion import LOWER_LID, UPPER_LID
from kouxing.shared.face.shapes import ARKIT, OCULUS, SHAPE_SETS, VRM, ShapeSet
from tests import heads
from tests.heads import neutral_faps


def weights_by_name(faps: np.ndarray, shapes: ShapeSet = ARKIT) -> dict[str, float]:
    return dict(zip(shapes.names, shapes.weights(faps).tolist(), strict=True))


def test_recovers_single_shapes() -> None:
    weights = np.array([ARKIT.weights(faps) for faps in ARKIT.basis])
    assert weights.argmax(axis=1).tolist() == [*range(len(ARKIT.names))]
    assert np.diag(weights).min() > 0.55  # some shapes are similar to sums of others


@pytest.mark.parametrize("name", SHAPE_SETS)
def test_solution_is_optimal(name: str) -> None:
    shapes = SHAPE_SETS[name]
    root = np.linalg.cholesky(shapes._gram)
    random = np.random.default_rng(1)
    faces = [random.uniform(0, 1, len(shapes.names)) ** 4 @ shapes.basis for _ in range(20)]
    for faps in [*VISEMES, *(3 * EXPRESSIONS), *faces, random.normal(0, 300, NUM_FAPS)]:
        right = np.linalg.solve(root, shapes._right @ faps.astype(float))
        best = lsq_linear(root.T, right, (0, 1), method="bvls").x
        np.testing.assert_allclose(shapes._solve(faps.astype(float)), best, atol=1e-3)


@pytest.mark.parametrize("shapes", SHAPE_SETS.values(), ids=SHAPE_SETS)
def test_closed_lips_and_lids_stay_closed(shapes: ShapeSet) -> None:
    inner = [FAP_NUMBER[name] - 1 for name in ("lower_t_midlip_o", "raise_b_midlip_o")]
    closed = VISEMES[1].copy()  # p b m
    closed[inner] = 0.0
    assert shapes.faps(shapes.weights(closed))[inner].sum() > -60  # 1 mm
    if shapes is not OCULUS:
        lids = neutral_faps(close_t_l_eyelid=UPPER_LID, close_b_l_eyelid=LOWER_LID)
        found = weights_by_name(lids, shapes)
        assert max(found.values()) == found.get("eyeBlinkLeft", found.get("blinkLeft"))
        assert max(found.values()) > 0.95


def test_vrm_blinks_add_up() -> None:
    both = weights_by_name(neutral_faps(close_t_l_eyelid=800, close_t_r_eyelid=800), VRM)
    assert both["blink"] > 0.5
    assert both["blinkLeft"] == both["blinkRight"] == 0
    wink = weights_by_name(neutral_faps(close_t_l_eyelid=800, close_t_r_eyelid=200), VRM)
    assert wink["blink"] == pytest.approx(both["blink"] / 4, abs=0.01)
    assert wink["blinkRight"] == 0


def test_shapes_move_the_mesh_as_named() -> None:
    head = heads.load("woman")

    def shift(name: str, point: str, *more: str) -> np.ndarray:
        faps = ARKIT.basis[[ARKIT.names.index(shape) for shape in (name, *more)]].sum(axis=0)
        vertex = head.feature_points[point]
        moved: np.ndarray = 1000 * (head.deform(faps) - head.vertices)[vertex]
        return moved

    assert shift("jawOpen", "2.3")[1] < -15
    assert shift("jawOpen", "9.11")[1] < -10  # teeth follow the jaw
    gap = shift("jawOpen", "2.2", "mouthClose") - shift("jawOpen", "2.3", "mouthClose")
    assert abs(gap[1]) < 1  # the lips meet with an open jaw
    assert shift("mouthSmileLeft", "2.4")[1] > 5
    assert shift("mouthPucker", "2.2")[2] > 5
    assert shift("eyeBlinkLeft", "3.1")[1] < -5
    assert shift("tongueOut", "6.1")[2] > 20
