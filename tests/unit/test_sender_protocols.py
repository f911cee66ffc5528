"""What other programs read of a face: VMC, Live Link Face, OSC, VTube Studio's parameters."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from kouxing.services.senders import live_link, osc, vmc, vtube_studio
from kouxing.services.senders.face import Face
from kouxing.services.senders.target import parse_target
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.shapes import SHAPE_SETS
from tests.receivers import LIVE_LINK_ORDER, read_live_link, read_osc

pytestmark = pytest.mark.unit


def face(shapes: str = "arkit", time_s: float = 0.0, /, **weights: float) -> Face:
    """Return a face of shapes, or of FAPs, by name."""
    faps = np.zeros(NUM_FAPS, np.float32)
    for name, weight in weights.items():
        if name in FAP_NUMBER:
            faps[FAP_NUMBER[name] - 1] = weight
        else:
            row = np.zeros(len(SHAPE_SETS[shapes].names), np.float32)
            row[SHAPE_SETS[shapes].names.index(name)] = weight
            faps += SHAPE_SETS[shapes].faps(row)
    return Face(faps, time_s)


# --- VMC -----------------------------------------------------------------------------------------


def test_vmc_names_expressions_as_vrm_0_and_vrm_1_do() -> None:
    shown = face("vrm", 2.5, aa=0.6, blinkLeft=0.5)
    (datagram,) = vmc.encode(shown, parse_target("vmc://"))
    messages = read_osc([datagram])
    assert messages[:2] == [("/VMC/Ext/OK", [1]), ("/VMC/Ext/T", [2.5])]
    assert messages[-1] == ("/VMC/Ext/Blend/Apply", [])
    values = {params[0]: params[1] for address, params in messages if address.endswith("/Val")}
    assert values.keys() >= {*"AIUEO", "Blink", "Blink_L", "Blink_R"}
    assert values.keys() >= {"aa", "ih", "ou", "ee", "oh", "blink", "blinkLeft", "blinkRight"}
    assert values["A"] == values["aa"] == pytest.approx(0.6, abs=0.05)
    assert values["Blink_L"] == values["blinkLeft"] == pytest.approx(0.5, abs=0.05)
    assert values["O"] < 0.1


def test_vmc_splits_perfect_sync_and_applies_it_once_at_the_end() -> None:
    shown = face(jawOpen=0.7)
    datagrams = list(vmc.encode(shown, parse_target("vmc://?shapes=arkit")))
    assert len(datagrams) == 4
    messages = read_osc(datagrams)
    names = [params[0] for address, params in messages if address == "/VMC/Ext/Blend/Val"]
    assert names[:52] == [name[0].upper() + name[1:] for name in names[52:]]  # as Unity has them
    assert names[52:] == list(SHAPE_SETS["arkit"].names)
    addresses = [address for address, _ in messages]
    assert addresses.count("/VMC/Ext/Blend/Apply") == 1
    assert addresses[-1] == "/VMC/Ext/Blend/Apply"


@pytest.mark.parametrize(
    ("fap", "quaternion"),
    [  # Unity: left-handed, x to the model's right, y up, z to the front
        ("head_pitch", (math.sin(0.1), 0.0, 0.0, math.cos(0.1))),  # down
        ("head_yaw", (0.0, -math.sin(0.1), 0.0, math.cos(0.1))),  # to its left
        ("head_roll", (0.0, 0.0, -math.sin(0.1), math.cos(0.1))),  # tilted to its right
    ],
)
def test_vmc_turns_the_head_if_asked(fap: str, quaternion: tuple[float, ...]) -> None:
    shown = face(**{fap: 0.2e5})
    bones = [
        params
        for address, params in read_osc(list(vmc.encode(shown, parse_target("vmc://?head=on"))))
        if address == "/VMC/Ext/Bone/Pos"
    ]
    assert [bone[:4] for bone in bones] == [["Head", 0.0, 0.0, 0.0]]
    assert bones[0][4:] == pytest.approx(quaternion, abs=1e-6)
    plain = read_osc(list(vmc.encode(shown, parse_target("vmc://"))))
    assert not any(address == "/VMC/Ext/Bone/Pos" for address, _ in plain)


def test_a_camera_may_keep_the_rest_of_the_face() -> None:
    shown = face("vrm", aa=0.6)
    messages = read_osc(list(vmc.encode(shown, parse_target("vmc://?only=mouth"))))
    names = {params[0] for address, params in messages if address == "/VMC/Ext/Blend/Val"}
    assert names == {*"AIUEO", "aa", "ih", "ou", "ee", "oh"}
    parameters = vtube_studio.parameters(shown, is_mouth_only=True)
    assert not any(name.startswith(("Eye", "Face", "Brow")) for name in parameters)


# --- Live Link Face ------------------------------------------------------------------------------


def test_live_link_face_version_6() -> None:
    shown = face(jawOpen=0.6, eyeBlinkRight=0.4, head_yaw=0.2e5, pitch_l_eyeball=0.1e5)
    datagram = live_link.encode(shown, parse_target("livelink://?name=Ada"), 3600.51)
    assert len(datagram) == 306 + len("Ada")
    fields = read_live_link(datagram)
    assert (fields["version"], len(fields["device"]), fields["name"]) == (6, 36, "Ada")
    assert fields["rate_hz"] == 50
    assert fields["frame"] == (180025, pytest.approx(0.5, abs=1e-3))
    values = fields["values"]
    assert len(values) == 61
    assert values[LIVE_LINK_ORDER.index("jawOpen")] == pytest.approx(0.6, abs=0.05)
    assert values[52:55] == pytest.approx((0.2, 0.0, 0.0))  # yaw, pitch, roll of the head
    assert values[55:] == pytest.approx((0.0, 0.1, 0.0, 0.0, 0.0, 0.0))


def test_live_link_face_has_all_weights_in_their_order() -> None:
    shown = face()
    weights = {name: number / 52 for number, name in enumerate(SHAPE_SETS["arkit"].names)}
    shown.weights = lambda *_, **__: weights  # type: ignore[method-assign] # each another
    fields = read_live_link(live_link.encode(shown, parse_target("livelink://"), 0.0))
    read = dict(zip(LIVE_LINK_ORDER, fields["values"], strict=False))
    assert read == pytest.approx(weights)


# --- OSC -----------------------------------------------------------------------------------------


def test_osc_has_an_address_for_each_shape() -> None:
    shown = face("oculus", 1.5, aa=0.5, head_pitch=math.radians(3) * 1e5)
    messages = dict(read_osc(list(osc.encode(shown, parse_target("osc://?shapes=oculus")))))
    assert messages["/kouxing/time"] == [1.5]
    assert messages["/kouxing/head"] == pytest.approx([3.0, 0.0, 0.0], abs=1e-3)
    assert messages["/kouxing/aa"] == pytest.approx([0.5], abs=0.05)
    assert len(messages) == 2 + 15
    target = parse_target("osc://?prefix=/avatar/parameters/")
    messages = dict(read_osc(list(osc.encode(shown, target))))
    assert "/avatar/parameters/jawOpen" in messages


# --- VTube Studio --------------------------------------------------------------------------------


def test_the_mouth_of_a_live2d_model() -> None:
    rest = vtube_studio.parameters(face(), is_mouth_only=False)
    assert (rest["MouthOpen"], rest["MouthSmile"], rest["EyeOpenLeft"]) == (0.0, 0.5, 1.0)
    wide = vtube_studio.parameters(face("vrm", aa=1.0), is_mouth_only=False)
    round_ = vtube_studio.parameters(face("vrm", ou=0.8), is_mouth_only=False)
    spread = vtube_studio.parameters(face("vrm", ih=0.8), is_mouth_only=False)
    assert wide["MouthOpen"] == pytest.approx(1.0)
    assert wide["VoiceA"] > 0.8
    assert round_["MouthSmile"] < 0.3
    assert spread["MouthSmile"] > 0.7
    turned = vtube_studio.parameters(
        face(head_yaw=math.radians(10) * 1e5, head_pitch=math.radians(5) * 1e5), is_mouth_only=False
    )
    assert turned["FaceAngleX"] == pytest.approx(10, abs=1e-3)
    assert turned["FaceAngleY"] == pytest.approx(-5, abs=1e-3)


def test_eyes_and_brows_of_a_live2d_model() -> None:
    rest = vtube_studio.parameters(face(), is_mouth_only=False)
    assert (rest["EyeLeftX"], rest["EyeRightY"], rest["Brows"]) == (0.0, 0.0, 0.5)
    left = {"eyeLookOutLeft": 0.6, "eyeLookInRight": 0.6}
    looking = vtube_studio.parameters(
        face(**left, eyeLookUpLeft=0.5, eyeLookUpRight=0.5), is_mouth_only=False
    )
    for side in ("Left", "Right"):
        assert looking[f"Eye{side}X"] == pytest.approx(-0.6, abs=0.1)
        assert looking[f"Eye{side}Y"] == pytest.approx(0.5, abs=0.1)
    frowning = vtube_studio.parameters(
        face(browDownLeft=0.8, browDownRight=0.8), is_mouth_only=False
    )
    surprised = vtube_studio.parameters(
        face(browInnerUp=1.0, browOuterUpLeft=1.0), is_mouth_only=False
    )
    assert frowning["Brows"] < 0.2
    assert surprised["BrowLeftY"] > 0.9
    assert 0.6 < surprised["BrowRightY"] < 0.9


def answer(kind: str, **data: object) -> str:
    return json.dumps({"apiName": "VTubeStudioPublicAPI", "messageType": kind, "data": data})


def test_vtube_studio_is_asked_for_a_token_once() -> None:
    kept: list[str] = []
    dialogue = vtube_studio.Dialogue("", kept.append)
    request = json.loads(dialogue.begin())
    assert request["messageType"] == "AuthenticationTokenRequest"
    assert request["data"] == {"pluginName": "kouxing", "pluginDeveloper": "kouxing"}
    assert "Allow" in dialogue.problem
    request = json.loads(
        dialogue.answer(answer("AuthenticationTokenResponse", authenticationToken="t"))
    )
    assert kept == ["t"]
    assert request["messageType"] == "AuthenticationRequest"
    assert request["data"]["authenticationToken"] == "t"
    request = json.loads(dialogue.answer(answer("AuthenticationResponse", authenticated=True)))
    assert request["messageType"] == "InputParameterListRequest"
    assert not dialogue.is_ready
    known = [{"name": "MouthOpen"}, {"name": "FaceAngleX"}]
    listed = answer("InputParameterListResponse", defaultParameters=known, customParameters=[])
    assert dialogue.answer(listed) == ""
    assert dialogue.is_ready
    frame = json.loads(dialogue.frame(face("vrm", aa=1.0), is_mouth_only=False))
    assert frame["messageType"] == "InjectParameterDataRequest"
    assert [each["id"] for each in frame["data"]["parameterValues"]] == ["MouthOpen", "FaceAngleX"]
    assert frame["data"]["faceFound"] is True


def test_a_token_that_was_taken_back_is_asked_for_again() -> None:
    dialogue = vtube_studio.Dialogue("old", lambda _: None)
    assert json.loads(dialogue.begin())["messageType"] == "AuthenticationRequest"
    request = json.loads(dialogue.answer(answer("AuthenticationResponse", authenticated=False)))
    assert request["messageType"] == "AuthenticationTokenRequest"


def test_vtube_studio_refuses() -> None:
    dialogue = vtube_studio.Dialogue("", lambda _: None)
    dialogue.begin()
    with pytest.raises(vtube_studio.Denied):
        dialogue.answer(answer("APIError", errorID=50, message="denied"))
    for number, reason in ((1, "Start API"), (51, "press Allow"), (500, "no such")):
        with pytest.raises(UserError, match=reason):  # and it is tried again
            dialogue.answer(answer("APIError", errorID=number, message="no such"))
    dialogue.is_ready = True
    assert dialogue.answer(answer("APIError", errorID=454, message="MouthOpen")) == ""
    assert "another plugin" in dialogue.problem
    dialogue.answer(answer("InjectParameterDataResponse"))
    assert dialogue.problem == ""
    for nonsense in ("x", "[]", "{}", answer("AuthenticationTokenResponse")):
        with pytest.raises(UserError, match="no VTube Studio"):
            dialogue.answer(nonsense)


# --- addresses -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "host", "port"),
    [
        ("vmc://", "127.0.0.1", 39540),
        ("vmc://:39539", "127.0.0.1", 39539),
        ("livelink://192.168.1.20", "192.168.1.20", 11111),
        ("osc://localhost", "localhost", 9000),
        ("vts://[::1]:8002/", "::1", 8002),
    ],
)
def test_an_address_without_a_host_is_this_machine(url: str, host: str, port: int) -> None:
    target = parse_target(url)
    assert (target.host, target.port) == (host, port)
    assert target.is_local == (host != "192.168.1.20")


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("vmc", "write vmc://HOST"),
        ("http://127.0.0.1", "write vmc://HOST"),
        ("vmc://host/path", "write vmc://HOST"),
        ("vmc://me@host", "write vmc://HOST"),
        ("vmc://host:99999", "write vmc://HOST"),
        ("vmc://?delai=3", "there are delay"),
        ("vmc://?shapes=fap", "vrm or arkit"),
        ("vts://?shapes=vrm", "no option"),
        ("vmc://?delay=-1", "milliseconds"),
        ("vmc://?delay=nan", "milliseconds"),
        ("osc://?prefix=kouxing", "begin with '/'"),
    ],
)
def test_a_wrong_address_says_what_is_expected(url: str, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        parse_target(url)
