"""Messages of the sender protocols, and target addresses."""

import json
import logging
import math
from collections.abc import Iterable
from typing import ClassVar

import numpy as np
import pytest

from kouxing.services.senders import protocols
from kouxing.services.senders.connection import COMMON_OPTIONS, DatagramConnection, Option
from kouxing.services.senders.face_frame import FaceFrame
from kouxing.services.senders.live_link import LiveLinkConnection
from kouxing.services.senders.protocols import make_connection, parse_target
from kouxing.services.senders.sender_pool import PAUSE_S, WINDOW_S, PlayoutClock
from kouxing.services.senders.vtube_studio import (
    AccessDenied,
    VTubeStudioProtocol,
    tracking_parameters,
)
from kouxing.shared.errors import UserError
from kouxing.shared.face.shapes import SHAPE_SETS
from tests.receivers import LIVE_LINK_ORDER, Messages, frame_of, read_live_link, read_osc


def osc_messages(url: str, frame: FaceFrame) -> Messages:
    """Return the OSC messages of a frame."""
    return read_osc(list(make_connection(parse_target(url)).encode(frame)))  # type: ignore[attr-defined]


def test_only_a_target_without_brows_needs_a_hint_for_expressions() -> None:
    assert "?shapes=arkit" in parse_target("vmc://").expression_hint
    for url in ("vmc://?shapes=arkit", "vmc://?only=mouth", "vts://", "livelink://"):
        assert not parse_target(url).expression_hint


def test_vmc_sends_the_names_of_vrm_0_and_vrm_1() -> None:
    messages = osc_messages("vmc://", frame_of("vrm", 2.5, aa=0.6, blinkLeft=0.5))
    assert messages[:2] == [("/VMC/Ext/OK", [1]), ("/VMC/Ext/T", [2.5])]
    assert messages[-1] == ("/VMC/Ext/Blend/Apply", [])
    values = {params[0]: params[1] for address, params in messages if address.endswith("/Val")}
    assert values.keys() >= {*"AIUEO", "Blink", "Blink_L", "Blink_R"}
    assert values.keys() >= {"aa", "ih", "ou", "ee", "oh", "blink", "blinkLeft", "blinkRight"}
    assert values["A"] == values["aa"] == pytest.approx(0.6, abs=0.05)
    assert values["Blink_L"] == values["blinkLeft"] == pytest.approx(0.5, abs=0.05)
    datagrams = list(
        make_connection(parse_target("vmc://?shapes=arkit")).encode(frame_of(jawOpen=0.7))  # type: ignore[attr-defined]
    )
    assert len(datagrams) == 4
    messages = read_osc(datagrams)
    names = [params[0] for address, params in messages if address == "/VMC/Ext/Blend/Val"]
    assert names[:52] == [name[0].upper() + name[1:] for name in names[52:]]
    assert names[52:] == list(SHAPE_SETS["arkit"].names)
    addresses = [address for address, _ in messages]
    assert addresses.index("/VMC/Ext/Blend/Apply") == len(addresses) - 1


@pytest.mark.parametrize(
    ("fap", "quaternion"),
    [  # Unity: left-handed, x to the model's right, y up, z to the front
        ("head_pitch", (math.sin(0.1), 0.0, 0.0, math.cos(0.1))),  # down
        ("head_yaw", (0.0, -math.sin(0.1), 0.0, math.cos(0.1))),  # to its left
        ("head_roll", (0.0, 0.0, -math.sin(0.1), math.cos(0.1))),  # tilted to its right
    ],
)
def test_vmc_rotates_the_head_if_requested(fap: str, quaternion: tuple[float, ...]) -> None:
    frame = frame_of(**{fap: 0.2e5})
    messages = osc_messages("vmc://?head=on", frame)
    bones = [params for address, params in messages if address == "/VMC/Ext/Bone/Pos"]
    assert [bone[:4] for bone in bones] == [["Head", 0.0, 0.0, 0.0]]
    assert bones[0][4:] == pytest.approx(quaternion, abs=1e-6)
    assert not any(address == "/VMC/Ext/Bone/Pos" for address, _ in osc_messages("vmc://", frame))


def test_live_link_datagram() -> None:
    frame = frame_of(jawOpen=0.6, eyeBlinkRight=0.4, head_yaw=0.2e5, pitch_l_eyeball=0.1e5)
    datagram = LiveLinkConnection(parse_target("livelink://?name=Ada")).encode_at(frame, 3600.51)
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
    weights = {name: number / 52 for number, name in enumerate(SHAPE_SETS["arkit"].names)}
    frame.weights = lambda *_, **__: weights  # type: ignore[method-assign]
    fields = read_live_link(LiveLinkConnection(parse_target("livelink://")).encode_at(frame, 0.0))
    assert dict(zip(LIVE_LINK_ORDER, fields["values"], strict=False)) == pytest.approx(weights)


def test_osc_has_one_address_per_shape() -> None:
    frame = frame_of("oculus", 1.5, aa=0.5, head_pitch=math.radians(3) * 1e5)
    messages = dict(osc_messages("osc://?shapes=oculus", frame))
    assert messages["/kouxing/time"] == [1.5]
    assert messages["/kouxing/head"] == pytest.approx([3.0, 0.0, 0.0], abs=1e-3)
    assert messages["/kouxing/aa"] == pytest.approx([0.5], abs=0.05)
    assert len(messages) == 2 + 15
    prefixed = dict(osc_messages("osc://?prefix=/avatar/parameters/", frame))
    assert "/avatar/parameters/jawOpen" in prefixed


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (frame_of(), {"MouthOpen": 0, "MouthSmile": 0.5, "EyeOpenLeft": 1, "Brows": 0.5}),
        (frame_of("vrm", aa=1.0), {"MouthOpen": 1, "VoiceA": 0.9}),
        (frame_of("vrm", ou=0.8), {"MouthSmile": 0.2}),
        (frame_of("vrm", ih=0.8), {"MouthSmile": 0.8}),
        (frame_of(head_yaw=math.radians(10) * 1e5), {"FaceAngleX": 10}),
        (frame_of(head_pitch=math.radians(5) * 1e5), {"FaceAngleY": -5}),
        (frame_of(eyeLookOutLeft=0.6, eyeLookInRight=0.6), {"EyeLeftX": -0.6, "EyeRightX": -0.6}),
        (frame_of(eyeLookUpLeft=0.5, eyeLookUpRight=0.5), {"EyeLeftY": 0.5, "EyeRightY": 0.5}),
        (frame_of(browDownLeft=0.8, browDownRight=0.8), {"Brows": 0.1}),
        (frame_of(browInnerUp=1.0, browOuterUpLeft=1.0), {"BrowRightY": 0.75, "BrowLeftY": 0.95}),
    ],
)
def test_vtube_studio_parameters(frame: FaceFrame, expected: dict[str, float]) -> None:
    parameters = tracking_parameters(frame, is_mouth_only=False)
    assert {name: parameters[name] for name in expected} == pytest.approx(expected, abs=0.15)


def response(kind: str, **data: object) -> str:
    return json.dumps({"apiName": "VTubeStudioPublicAPI", "messageType": kind, "data": data})


def test_vtube_studio_errors_are_explained_or_ignored() -> None:
    dialogue = VTubeStudioProtocol("revoked", lambda _: None)
    assert json.loads(dialogue.first_message())["messageType"] == "AuthenticationRequest"
    request = json.loads(dialogue.reply(response("AuthenticationResponse", authenticated=False)))
    assert request["messageType"] == "AuthenticationTokenRequest"
    with pytest.raises(AccessDenied):
        dialogue.reply(response("APIError", errorID=50, message="denied"))
    for number, reason in ((1, "Start API"), (51, "press Allow"), (500, "no such")):
        with pytest.raises(UserError, match=reason):
            dialogue.reply(response("APIError", errorID=number, message="no such"))
    dialogue.is_ready = True
    assert dialogue.reply(response("APIError", errorID=454, message="MouthOpen")) == ""
    assert "another plugin" in dialogue.problem
    dialogue.reply(response("InjectParameterDataResponse"))
    assert dialogue.problem == ""
    for nonsense in ("x", "[" * 100_000, "[]", "{}", response("AuthenticationTokenResponse")):
        with pytest.raises(UserError, match="not VTube Studio"):
            dialogue.reply(nonsense)


@pytest.mark.parametrize(
    ("url", "others"),
    [
        ("vmc://127.0.0.1", ["vmc://", "VMC://127.0.0.1/", "vmc://127.0.0.1:39540?"]),
        ("vmc://127.0.0.1", ["vmc://localhost", "vmc://?delay=0&head=off&camera="]),
        ("osc://127.0.0.1?delay=2&shapes=vrm", ["osc://?shapes=vrm&prefix=&delay=2"]),
        ("livelink://127.0.0.1?name=口%26型", ["livelink://?delay=0&name=%E5%8F%A3%26型"]),
        ("vmc://127.0.0.1:39541", ["vmc://:39541", "vmc://127.0.0.1:39541/"]),
        ("osc://pc.local?delay=2&prefix=/A/", ["OSC://PC.local:9000/?prefix=/A/&delay=2"]),
        ("vts://[::1]", ["vts://[::1]:8001", "VTS://[0:0:0:0:0:0:0:1]/"]),
        ("livelink://127.0.0.1", ["livelink://", "livelink://127.0.0.1:11111"]),
    ],
)
def test_all_spellings_of_an_address_become_one(url: str, others: list[str]) -> None:
    assert [parse_target(other) for other in others] == [parse_target(url)] * len(others)
    assert parse_target(url).url == url


def test_options_do_not_identify_a_target() -> None:
    assert parse_target("vmc://?delay=120").key == parse_target("vmc://?delay=1.2e2").key
    keys = {parse_target(url).key for url in ("vmc://", "osc://", "vmc://:1", "vmc://pc")}
    assert len(keys) == 4


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("vmc", "write vmc://HOST"),
        ("vmc://me@host", "write vmc://HOST"),
        ("vmc://host:99999", "write vmc://HOST"),
        ("vmc://host:0", "write vmc://HOST"),
        ("vmc://a..b", "write vmc://HOST"),
        (f"vts://{'a' * 64}", "write vmc://HOST"),
        ("vmc://?delai=3", "use delay"),
        ("vmc://?shapes=fap", "vrm or arkit"),
        ("vts://?shapes=vrm", "unknown option"),
        ("vmc://?delay=-1", "0 or 1 to 10000 ms"),
        ("vmc://?delay=0.12", "must be 0 or 1 to 10000 ms, not '0.12'"),
        ("osc://?prefix=kouxing", "start with '/'"),
        (f"osc://?prefix=/{'a' * 64}", "longer than 64"),
        ("osc://?prefix=/%00/", "not printable"),
        ("vmc://?head=on&only=mouth", "leave out head=on"),
        ("vmc://127.0.0.1:39539?camera=39539", "camera=39539 is the port of the avatar"),
        ("livelink://localhost?camera=0.0.0.0:11111", "camera=11111 is the port of the avatar"),
    ],
)
def test_error_of_an_invalid_address(url: str, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        parse_target(url)


class PlainConnection(DatagramConnection):
    """A protocol of another distribution."""

    default_port = 7000
    contents = "the time"
    options: ClassVar = {**COMMON_OPTIONS, "format": Option("text", ("text",))}

    def encode(self, frame: FaceFrame) -> Iterable[bytes]:
        yield b"%.1f" % frame.time_s


def test_other_distributions_add_protocols(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    here = f"{__name__}:PlainConnection"
    references = {"plain": here, "missing": "no_such_module:Sender", "wrong": "json:JSONDecoder"}
    monkeypatch.setattr(protocols, "plugins", lambda _group: references)
    protocols.protocols.cache_clear()
    try:
        with caplog.at_level(logging.WARNING):
            target = parse_target("plain://")
        assert (target.port, target.contents) == (7000, "the time and head")
        assert list(make_connection(target).encode(frame_of(jawOpen=0.7))) == [b"0.0"]  # type: ignore[attr-defined]
        with pytest.raises(UserError, match="format must be text"):
            parse_target("plain://?format=json")
        with pytest.raises(UserError, match="vts://HOST:8001 or plain://HOST:7000"):
            parse_target("missing://")
        assert "missing from no_such_module:Sender: No module" in caplog.text
        assert "json:JSONDecoder is not a TargetConnection" in caplog.text
    finally:
        protocols.protocols.cache_clear()


def test_playout_removes_jitter() -> None:
    playout, rng = PlayoutClock(), np.random.default_rng(0)
    jitter_s = rng.uniform(0.0, 0.05, 500)
    jitter_s[3] = 0.0
    earliest_s = [
        playout.earliest_s(number / 50, 100.0 + number / 50 + late_s)
        for number, late_s in enumerate(jitter_s)
    ]
    steps_s = np.diff(earliest_s[int(WINDOW_S * 50) :])
    assert np.abs(steps_s - 0.02).max() < 0.005
    assert all(time_s <= 100.0 + n / 50 + jitter_s[n] for n, time_s in enumerate(earliest_s))


def test_playout_delay_is_unchanged_after_a_pause() -> None:
    playout = PlayoutClock()
    for number in range(100):
        playout.earliest_s(number / 50, number / 50)
    stalled_s = 99 / 50
    for number in range(100, 150):  # the face fades to rest while media time does not advance
        playout.earliest_s(stalled_s, number / 50)
    resumed_s = [playout.earliest_s(stalled_s + n / 50, 3.0 + n / 50) for n in range(1, 50)]
    assert resumed_s == pytest.approx([3.0 + n / 50 for n in range(1, 50)], abs=0.021)
    later_s = 10.0 + PAUSE_S
    assert playout.earliest_s(3.0, later_s) == later_s
    assert playout.earliest_s(0.0, later_s) == later_s  # another session
