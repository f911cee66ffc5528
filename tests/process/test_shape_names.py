"""The Python and JavaScript code finds the same shapes; Blender's add-on has the same table."""

import json
import subprocess

from kouxing.shared.errors import UserError
from kouxing.shared.face.shape_names import choose_set, find_shapes
from tests.system import NODE, ROOT

MESHES = [
    "Face.jawOpen mouthPucker mouthSmile.L mouthSmileR BROWINNERUP eyeLookOut_L head_A",
    "CC_Base.Jaw_Open Mouth_Pucker_Up_L Mouth_Pucker_Down_R Eye_L_Look_L Brow_Raise_Inner_L",
    "G8__facs_bs_MouthSmileLeft_div2 eCTRLEyesClosedL eCTRLvAA facs_ctrl_vM eCTRLvUW",
    "vrc.v_aa vrc.v_E vrc.v_pp viseme_ih viseme_O viseme_U viseme_aa",
    "A I U E O Blink_L Fcl_MTH_A Fcl_EYE_Close Face.M_F00_000_Fcl_MTH_I \u3042",
    "A I happy",
    "I U E O",
    "happy Blink",
    "jawOpen",
    "jawOpen.001 bsMouthPucker mouthSmile_L_2 headAa",
    "mouthOpen mouthSmile A_1 eyeBlinkLeft",
    "0 1 2",
    "あ い う え お まばたき ウィンク２右",
    "ア イ Face.ウ エ ｵ 笑い ウィンク ウィンク右",
    "vowel_a Vowel_I VOWEL_U Face_Vowel_E vowel_o wink_left Wink.R EYE_DEF_C",
]
SETS = ("arkit", "oculus", "vrm")

JAVASCRIPT = """
import { readFileSync } from "node:fs";
import { chooseSet, findShapes } from "./shape-names.js";
const chosen = (names) => {
  try { return chooseSet(names); } catch (error) { return error.message; }
};
const meshes = JSON.parse(readFileSync(0, "utf8"));
console.log(JSON.stringify(meshes.map((names) => [
  chosen(names),
  ...["arkit", "oculus", "vrm"].map((set) => Object.fromEntries(findShapes(set, names))),
])));
"""


def expected() -> list[list[object]]:
    rows: list[list[object]] = []
    for names in map(str.split, MESHES):
        try:
            chosen: str = choose_set(names)
        except UserError as error:
            chosen = str(error)
        rows.append([chosen, *(find_shapes(set_name, names) for set_name in SETS)])
    return rows


def test_javascript_finds_the_same_shapes() -> None:
    result = subprocess.run(
        [NODE, "--input-type=module", "-e", JAVASCRIPT],
        input=json.dumps([mesh.split() for mesh in MESHES]),
        stdout=subprocess.PIPE,
        encoding="utf-8",
        cwd=ROOT / "clients" / "javascript",
        check=True,
    )
    assert json.loads(result.stdout) == expected()
