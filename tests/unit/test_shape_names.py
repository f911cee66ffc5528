"""The names of shapes in avatars of many programs."""

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.face.shape_names import TABLE, choose_set, find_shapes
from kouxing.shared.face.shapes import SHAPE_SETS
from tests.system import ROOT


@pytest.mark.parametrize(
    ("set_name", "shape", "names"),
    [
        (
            "arkit",
            "mouthSmileLeft",
            "mouthSmileLeft mouthSmile_L mouthSmile.L mouthSmileL MOUTHSMILE_LEFT Mouth_Smile_L"
            " blendShape1.mouthSmile_L Head|mouthSmileLeft G8__facs_bs_MouthSmileLeft_div2",
        ),
        ("arkit", "mouthPucker", "mouthPucker CC_Base_Body.Mouth_Pucker_Up_L"),
        ("arkit", "eyeLookOutLeft", "Eye_L_Look_L eyeLookOut_L"),
        ("arkit", "eyeBlinkRight", "eCTRLEyesClosedR eyeBlink_R"),
        ("oculus", "aa", "viseme_aa vrc.v_aa VRC.V_AA eCTRLvAA facs_ctrl_vAA V_Open Body.v_aa"),
        ("oculus", "E", "viseme_E vrc.v_e eCTRLvEH"),
        ("oculus", "ou", "viseme_U viseme_ou vrc.v_ou"),
        ("oculus", "PP", "viseme_PP vrc.v_pp V_Explosive"),
        ("vrm", "aa", "A aa Fcl_MTH_A Face.M_F00_000_00_Fcl_MTH_A あ"),
        ("vrm", "blinkLeft", "Blink_L blinkLeft Fcl_EYE_Close_L vrc.blink_left"),
        ("vrm", "", "Hair_A Key_E happy"),
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


def test_knows_all_shapes_and_every_program_has_the_same_table() -> None:
    for set_name, shapes in SHAPE_SETS.items():
        assert find_shapes(set_name, shapes.names) == dict(
            zip(shapes.names, shapes.names, strict=True)
        )
    for path in (
        "clients/javascript/shape-names.js",
        "examples/blender/kouxing_face.py",
        "examples/godot/kouxing_shape_names.gd",
        "examples/unity/KouxingShapeNames.cs",
    ):
        text = (ROOT / path).read_text(encoding="utf-8")
        assert TABLE in text, f"copy shared/face/shape_names.txt into {path}"
        assert "the avatar cannot speak: it has no shape" in text, path
