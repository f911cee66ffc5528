"""Shapes of ARKit, Oculus and VRM: their weights, and their names in avatars of many programs."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.high_level_faps import EXPRESSIONS, VISEMES
from kouxing.shared.face.idle_motion import LOWER_LID, UPPER_LID
from kouxing.shared.face.shape_names import TABLE, choose_set, find_shapes
from kouxing.shared.face.shapes import ARKIT, OCULUS, SHAPE_SETS, VRM, ShapeSet
from tests import heads
from tests.heads import neutral_faps
from tests.system import ROOT


def weights_by_name(faps: np.ndarray, shapes: ShapeSet = ARKIT) -> dict[str, float]:
    return dict(zip(shapes.names, shapes.weights(faps).tolist(), strict=True))


def test_recovers_single_shapes() -> None:
    weights = np.array([ARKIT.weights(faps) for faps in ARKIT.basis])
    assert weights.argmax(axis=1).tolist() == [*range(len(ARKIT.names))]
    assert np.diag(weights).min() > 0.55  # some shapes are similar to sums of others


@pytest.mark.parametrize("name", SHAPE_SETS)
def test_solution_is_optimal(name: str) -> None:
    shapes = SHAPE_SETS[name]
    root = np.linalg.cholesky(shapes.gram)
    random = np.random.default_rng(1)
    faces = [random.uniform(0, 1, len(shapes.names)) ** 4 @ shapes.basis for _ in range(20)]
    for faps in [*VISEMES, *(3 * EXPRESSIONS), *faces, random.normal(0, 300, NUM_FAPS)]:
        right = np.linalg.solve(root, shapes.right @ faps.astype(float))
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
        blink = weights_by_name(lids, shapes)
        assert max(blink.values()) == blink.get("eyeBlinkLeft", blink.get("blinkLeft"))
        assert max(blink.values()) > 0.95


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


@pytest.mark.parametrize(
    ("set_name", "shape", "names"),
    [
        (
            "arkit",
            "mouthSmileLeft",
            "mouthSmileLeft mouthSmile_L mouthSmile.L mouthSmileL MOUTHSMILE_LEFT Mouth_Smile_L"
            " blendShape1.mouthSmile_L Head|mouthSmileLeft G8__facs_bs_MouthSmileLeft_div2"
            " mouthSmile_L.001 mouthSmileLeft_2",
        ),
        ("arkit", "jawOpen", "jawOpen.001 bsJawOpen face.bsJawOpen_2 CTRL_expressions_jawOpen"),
        ("arkit", "jawOpen", "mouthOpen Wolf3D_Head.mouthOpen"),
        ("vrm", "blinkLeft", "eyeBlinkLeft"),
        ("arkit", "mouthPucker", "mouthPucker CC_Base_Body.Mouth_Pucker_Up_L"),
        ("arkit", "eyeLookOutLeft", "Eye_L_Look_L eyeLookOut_L"),
        ("arkit", "eyeBlinkRight", "eCTRLEyesClosedR eyeBlink_R"),
        ("oculus", "aa", "viseme_aa vrc.v_aa VRC.V_AA eCTRLvAA facs_ctrl_vAA V_Open Body.v_aa"),
        ("oculus", "E", "viseme_E vrc.v_e eCTRLvEH"),
        ("oculus", "ou", "viseme_U viseme_ou vrc.v_ou"),
        ("oculus", "PP", "viseme_PP vrc.v_pp V_Explosive"),
        ("vrm", "aa", "A aa Fcl_MTH_A Face.M_F00_000_00_Fcl_MTH_A あ ア ｱ Face.ア Vowel_A vowel_a"),
        ("vrm", "aa", "VOWEL_A.001 Face_Vowel_A mouth_a MouthA lip_a ah"),
        ("vrm", "oh", "お オ ｵ vowel_o MTH_O"),
        ("vrm", "blink", "まばたき 瞬き EYE_DEF_C Face.まばたき"),
        ("vrm", "blinkLeft", "Blink_L blinkLeft Fcl_EYE_Close_L vrc.blink_left"),
        ("vrm", "blinkLeft", "ウィンク ウィンク２ ｳｨﾝｸ２ wink_left Wink.L"),
        ("vrm", "blinkRight", "ウィンク右 ｳｨﾝｸ２右 ウィンク2右 WinkRight"),
        ("vrm", "", "Hair_A Key_E happy HairA faceAa Key_1"),
    ],
)
def test_finds_the_shape_of_a_name(set_name: str, shape: str, names: str) -> None:
    for name in names.split():
        assert find_shapes(set_name, [name]) == ({name: shape} if shape else {}), name


def test_a_shape_is_the_sum_of_its_parts_or_its_first_name() -> None:
    parts = ["Brow_Raise_Inner_L", "Brow_Raise_Inner_R"]
    assert find_shapes("arkit", parts) == dict.fromkeys(parts, "browInnerUp")
    assert find_shapes("arkit", [*parts, "browInnerUp"]) == {"browInnerUp": "browInnerUp"}
    assert find_shapes("arkit", ["jaw_open", "jawOpen"]) == {"jaw_open": "jawOpen"}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("jawOpen mouthPucker viseme_aa A", "arkit"),
        ("viseme_sil viseme_PP viseme_aa viseme_I viseme_O viseme_U", "oculus"),
        ("A I U E O Blink", "vrm"),
        ("jawOpen eyeBlinkLeft", "arkit"),
        ("A I", "vrm"),
        ("jawOpen A I U E O", "vrm"),
        ("mouthPucker eyeBlinkLeft", "it has no shape jawOpen of ARKit"),
        ("I U E O", "it has no shape aa of VRM"),
        ("happy Blink", "it has no shape aa, ih, ou, ee, oh of VRM"),
        ("0 1 2", "the avatar cannot speak: it has no shape jawOpen, mouthPucker of ARKit"),
        ("", "the avatar cannot speak: it has no shape jawOpen, mouthPucker of ARKit"),
    ],
)
def test_chooses_a_set_or_names_what_is_missing(names: str, expected: str) -> None:
    try:
        assert choose_set(names.split()) == expected
    except UserError as error:
        assert expected in str(error)  # noqa: PT017


def test_has_all_shapes_and_every_program_has_the_same_table() -> None:
    for set_name, shapes in SHAPE_SETS.items():
        assert find_shapes(set_name, shapes.names) == dict(
            zip(shapes.names, shapes.names, strict=True)
        )
    for path in ("clients/javascript/shape-names.js", "examples/blender/kouxing_face.py"):
        text = (ROOT / path).read_text(encoding="utf-8")
        assert TABLE in text, f"copy shared/face/shape_names.txt into {path}"
        assert "the avatar cannot speak: it has no shape" in text, path
