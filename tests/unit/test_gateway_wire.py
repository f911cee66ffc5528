"""Messages of browsers, checked field by field, and the bounded queues of messages to viewers."""

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kouxing.services.gateway.audio.sample_sentence import SampleSentence
from kouxing.services.gateway.messages import browser_messages
from kouxing.services.gateway.messages.browser_messages import parse_face_settings
from kouxing.services.gateway.messages.pcm_format import PcmFormat
from kouxing.services.gateway.messages.shape_messages import make_avatar_encoder, parse_shape_query
from kouxing.services.gateway.viewers.viewer_handler import PAUSE_S, Viewer, ViewerHandler
from kouxing.services.gateway.viewers.viewer_queue import (
    MAX_QUEUED,
    NUM_FRAMES_KEPT,
    MessageKind,
    ViewerQueue,
)
from kouxing.services.gateway.web.access import AccessPolicy
from kouxing.services.gateway.web.web_application import OpenWebSockets, make_application
from kouxing.shared.errors import UserError
from kouxing.shared.face.idle_motion import RestingFace
from kouxing.shared.face.lip_constants import MAX_MOUTH_PROFILE_BYTES
from kouxing.shared.face.shapes import VRM
from kouxing.shared.monitoring.metrics import Metrics
from kouxing.shared.wire.face import FaceSettings

LONG_PROFILE = "AAAA" * (MAX_MOUTH_PROFILE_BYTES // 3 + 1)


def test_hello_describes_the_audio() -> None:
    hello, problem = browser_messages.parse_microphone_options(
        '{"sample_rate_hz": 44100, "num_channels": 2, "encoding": "f32le"}'
    )
    assert (hello.sample_rate_hz, hello.num_channels, hello.encoding) == (44100, 2, "f32le")
    assert hello.frame_bytes == 8
    assert hello.mouth_profile == b""
    assert hello.language == ""
    assert not hello.ahead
    assert problem == ""
    hello, _ = browser_messages.parse_microphone_options(
        '{"sample_rate_hz": 8000, "mouth_profile": "YWJj", "language": "de", "ahead": 1}'
    )
    assert hello.language == "de"
    assert hello.mouth_profile == b"abc"
    assert hello.ahead


def test_parses_microphone_commands() -> None:
    assert browser_messages.parse_command('{"flush": true}').flush
    assert browser_messages.parse_command('{"skip": 960}').skip == 960
    pcm_format = PcmFormat(sample_rate_hz=16000)
    browser_messages.parse_command('{"sample_rate_hz": 16000, "encoding": "s16le"}', pcm_format)
    with pytest.raises(UserError, match="sample_rate_hz cannot change during a session"):
        browser_messages.parse_command('{"sample_rate_hz": 48000}', pcm_format)
    assert browser_messages.parse_command('{"last": true}').last
    assert browser_messages.parse_command('{"eof": 1}').last  # as in version 0.1.0
    for message in ('{"lips": ""}', '{"lip_model": null}'):
        assert browser_messages.parse_command(message).face == {}
    command = browser_messages.parse_command('{"lip_model": "ferguson"}')
    assert command.problem == ""
    assert FaceSettings(**command.face) == FaceSettings(lip_model="ferguson")


def test_names_the_unknown_fields_of_a_microphone() -> None:
    command = browser_messages.parse_command('{"stop": true, "flush": true, "encoding": "s16le"}')
    assert command.flush
    assert command.problem.startswith("unknown field stop; use skip, flush, last, lip_model, ")
    command = browser_messages.parse_command('{"language": "en", "flush": true}')
    assert command.flush
    assert command.problem == "language cannot change during a session; open another connection"
    command = browser_messages.parse_command(json.dumps(dict.fromkeys(["x" * 30, "y" * 30])))
    assert command.problem.startswith(f"unknown fields {'x' * 30}, yyyyyyy…; use ")
    options = '{"sample_rate_hz": 16000, "channels": 2}'
    _, problem = browser_messages.parse_microphone_options(options)
    assert problem.startswith("unknown field channels; use sample_rate_hz, num_channels, ")


@pytest.mark.parametrize(
    "fields",
    [
        {"expressions": {"joy": 1}, "hold_s": 7, "expressiveness": 2},
        {"feeling": 0, "still": True, "eye_contact": False, "listen_to": "bob"},
        {"expressions": {}},
        {"lip_model": "learned"},
        {"acoustic": "light"},
    ],
)
def test_parses_face_settings(fields: dict[str, Any]) -> None:
    expected = FaceSettings(**fields)
    assert parse_face_settings(fields | {"follow": "one"}) == expected
    assert parse_face_settings({"follow": "one"}) is None


def parse_hello(fields: object) -> object:
    return browser_messages.parse_microphone_options(json.dumps(fields))


def parse_command(fields: object) -> object:
    return browser_messages.parse_command(json.dumps(fields))


def parse_viewer(fields: object) -> object:
    return browser_messages.parse_viewer_command(json.dumps(fields))


def parse_avatar(meshes: list[list[str]]) -> object:
    return make_avatar_encoder(meshes, "binary")


AT_16_KHZ = {"sample_rate_hz": 16000}


@pytest.mark.parametrize(
    ("parse", "fields", "error"),
    [
        (parse_hello, {}, "^sample_rate_hz is missing$"),
        (parse_hello, {"sample_rate": 16000}, "; unknown field sample_rate; use sample_rate_hz, "),
        (parse_hello, {"sample_rate_hz": 96000}, "must be an integer of at most 48000"),
        (
            parse_hello,
            AT_16_KHZ | {"num_channels": 3},
            "num_channels must be an integer of at most 2",
        ),
        (parse_hello, AT_16_KHZ | {"encoding": "opus"}, "encoding must be s16le or f32le"),
        (parse_hello, AT_16_KHZ | {"language": 1}, "language must be a string, not an integer"),
        (parse_hello, AT_16_KHZ | {"ahead": "false"}, "ahead must be true or false, not a string"),
        (parse_hello, AT_16_KHZ | {"mouth_profile": "no base64!"}, "mouth_profile"),
        (parse_hello, AT_16_KHZ | {"mouth_profile": LONG_PROFILE}, "mouth_profile"),
        (parse_hello, [1], "object"),
        (parse_command, {"flush": "no"}, "flush must be true or false, not a string"),
        (parse_command, {"last": [0]}, "last must be true or false, not a list"),
        (parse_command, {"eof": 2}, "last must be true or false, not an integer"),
        (parse_command, {"lip_model": 1}, "lip_model is 1; it must be dynamic-visemes or "),
        *(
            (parse_command, {"skip": n}, "skip must be an integer")
            for n in (-1, 1.5, True, browser_messages.MAX_SKIPPED_SAMPLES + 1)
        ),
        (parse_face_settings, {"expressions": {"glee": 0.5}}, "glee"),
        (parse_face_settings, {"expressions": {"joy": 2}}, "joy: strength 2"),
        (parse_face_settings, {"expressions": {"joy": 1}, "hold_s": "long"}, "hold_s is long"),
        (parse_face_settings, {"expressions": [1]}, "must be an object, not a list"),
        (parse_face_settings, {"feeling": -1}, "feeling must be a number of at least 0"),
        (parse_face_settings, {"listen_to": "a b"}, "listen_to is not a valid name; use "),
        (parse_face_settings, {"acoustic": "heavy"}, '"heavy"; it must be full or light'),
        (parse_face_settings, {"acoustic": [1]}, r"acoustic is \[1\]; it must be full or light"),
        (parse_face_settings, {"lip_model": "lerned"}, "it must be dynamic-visemes or .*learned"),
        (parse_face_settings, {"lip_model": ["a"] * 9999}, r'\["a", .*, "a"…; it must be dynamic-'),
        (parse_face_settings, {"hold_s": 3}, "hold_s is how long expressions last; send it with"),
        (parse_viewer, {"avatar": "jawOpen"}, "avatar must be a list, not a string"),
        (parse_viewer, {"avatar": [["x" * 129]]}, "must be a string of at most 128 characters"),
        (parse_viewer, {"avatar": [["jawOpen"]], "format": "xml"}, "format must be binary or "),
        (parse_avatar, [["jawOpen"] * 600] * 2, "more than 1024 shapes"),
        (parse_avatar, [["Basis"], []], "the avatar cannot speak"),
    ],
)
def test_a_message_that_cannot_be_used_is_rejected_with_its_fault(
    parse: Callable[[Any], object], fields: object, error: str
) -> None:
    with pytest.raises(UserError, match=error):
        parse(fields)


@pytest.mark.parametrize("message", ["", "{", "[" * 100_000, "null", '"text"', r'{"\ud800": 1}'])
def test_rejects_messages_that_are_not_objects(message: str) -> None:
    with pytest.raises(UserError, match="JSON object"):
        browser_messages.parse_object(message)


UNUSED: Any = lambda *_: None  # noqa: E731 - calls that these tests do not need


@pytest.mark.parametrize("message_format", ["binary", "json"])
def test_an_avatar_gets_the_weights_of_its_shapes(message_format: str) -> None:
    meshes = [["Basis", "Fcl_MTH_A"], ["Blink", "A", "Fcl_MTH_U"]]
    encoder = make_avatar_encoder(meshes, message_format)
    targets = json.loads(encoder.header_message())["targets"]
    assert sorted(targets) == [[0, 1], [1, 0], [1, 1], [1, 2]]
    faps = np.arange(68).astype("<f4")
    weights = dict(zip(VRM.names, VRM.weights(faps).tolist(), strict=True))
    shapes = {(0, 1): "aa", (1, 0): "blink", (1, 1): "aa", (1, 2): "ou"}
    message = encoder.encode("weights", 1, 320, faps.tobytes())
    received = (
        np.frombuffer(message, "<f4", offset=16)
        if isinstance(message, bytes)
        else json.loads(message)["weights"]
    )
    expected = [weights[shapes[mesh, shape]] for mesh, shape in targets]
    np.testing.assert_allclose(received, expected, atol=1e-4)
    assert max(expected) > 0.01


@pytest.mark.parametrize(("name", "error"), [("a.glb", "no such file"), ("a.vrm", "GLB file; run")])
def test_the_page_needs_a_glb_file_as_its_head(tmp_path: Path, name: str, error: str) -> None:
    (tmp_path / "a.vrm").touch()
    with pytest.raises(UserError, match=error):
        make_application(head=str(tmp_path / name), routes=[], access=AccessPolicy())


def drain(viewer_queue: ViewerQueue) -> list[str | bytes]:
    async def take_all() -> list[str | bytes]:
        return [await viewer_queue.get() for _ in range(len(viewer_queue))]

    return asyncio.run(take_all())


def binary_types(viewer: Viewer) -> list[int]:
    """Return the types of the queued binary messages."""
    return [message[0] for message in drain(viewer.queue) if isinstance(message, bytes)]


def make_viewers() -> ViewerHandler:
    return ViewerHandler(OpenWebSockets(), 1.0, Metrics(), SampleSentence(UNUSED), UNUSED, UNUSED)


def texts(viewer: Viewer) -> list[dict[str, Any]]:
    """Return the queued JSON messages, without the status."""
    messages = [json.loads(text) for text in drain(viewer.queue) if isinstance(text, str)]
    return [message for message in messages if message["type"] != "status"]


def test_a_viewer_of_a_missing_session_gets_an_error() -> None:
    viewers = make_viewers()
    with viewers.connect_viewer("", None) as viewer:
        assert texts(viewer) == []
    with viewers.connect_viewer("talk", None) as viewer:
        (message,) = texts(viewer)
        assert (message["session"], message["chosen"]) == (None, "talk")
        viewers.add_session("other", 1, FaceSettings(), "zh")
        assert texts(viewer) == []
        viewers.add_session("talk", 1, FaceSettings(), "zh")
        assert [message["session"] for message in texts(viewer)] == ["talk"]
        viewers.remove_session("talk")
        assert [message["session"] for message in texts(viewer)] == [None]


def test_a_session_keeps_its_acoustic_model_when_it_moves() -> None:
    viewers = make_viewers()
    with viewers.connect_viewer("", None) as viewer:
        viewers.add_session("talk", 1, FaceSettings(), "zh")
        viewers.announce_acoustic_model("talk", "light")
        viewers.add_session("talk", 2, FaceSettings(), "zh")
        viewers.remove_session("talk")
        viewers.add_session("talk", 1, FaceSettings(), "zh")
        models = [message["acoustic"] for message in texts(viewer) if message.get("session")]
    assert models == ["full", "light", "full"]


@pytest.mark.parametrize(
    ("command", "error"),
    [
        ({"stop": True}, "unknown field stop; use follow, play, avatar, "),
        ({"follow": "a b"}, "follow is not a valid name; use "),
        ({"follow": "a\n"}, "follow is not a valid name; use "),
        ({"play": "song"}, "play must be sample"),
        ({"lip_model": ""}, "the message contains no command; send one of follow, play, avatar, "),
        ({}, "the message contains no command; send one of follow, play, avatar, "),
        ({"follow": "a", "expressions": {"joy": 1}}, "follow, play (with lip_model), avatar and "),
        ({"play": "sample", "lip_model": "learned", "feeling": 1}, "follow, play (with lip_mod"),
        ({"lip_model": "learned", "expressiveness": 2}, "follow, play (with lip_model), avatar"),
    ],
)
def test_answers_commands_of_viewers_without_effect(command: dict[str, object], error: str) -> None:
    viewers = make_viewers()
    with viewers.connect_viewer("", None) as viewer:
        viewers.handle_command(viewer, json.dumps(command))
        (message,) = texts(viewer)
        assert message["text"].startswith(error)


def test_a_viewer_that_joins_a_moving_face_gets_the_face_at_rest_once() -> None:
    viewers = make_viewers()
    face = RestingFace(idle_motion=False)
    frame = np.zeros(68, "<f4").tobytes()
    viewers.add_session("talk", 1, FaceSettings(), "zh")
    with viewers.connect_viewer("", None) as viewer:
        viewers.show_frame("talk", 1, 0, frame, now_s=0.0)
        assert viewers.resting_frame_due_s < 0
        viewers.show_resting_face(face, now_s=0.01)
        assert binary_types(viewer) == [browser_messages.FAP_TYPE, browser_messages.REST_TYPE]
        viewers.show_frame("talk", 1, 1, frame, now_s=0.02)
        viewers.show_resting_face(face, now_s=0.1)
        assert binary_types(viewer) == [browser_messages.FAP_TYPE]
        assert viewers.resting_frame_due_s == 0.02 + PAUSE_S
        viewers.show_resting_face(face, now_s=0.5)
        assert binary_types(viewer) == [browser_messages.REST_TYPE]


def test_drops_sound_and_old_frames_but_not_the_session() -> None:
    queue = ViewerQueue()
    queue.put(MessageKind.SESSION, "session")
    num_dropped = 0
    for number in range(MAX_QUEUED):
        kind = MessageKind.SOUND if number % 2 else MessageKind.FRAME
        num_dropped += queue.put(kind, b"%d" % number)

    left = drain(queue)
    assert left[0] == "session"
    assert len(left) == 1 + NUM_FRAMES_KEPT
    assert left[-1] == b"%d" % (MAX_QUEUED - 2)  # the newest frame
    assert num_dropped == MAX_QUEUED - NUM_FRAMES_KEPT


def test_a_slow_viewer_gets_the_newest_state_among_many_phones() -> None:
    viewers = make_viewers()
    viewers.announce_missing_services(())
    with viewers.connect_viewer("", parse_shape_query({"shapes": "arkit"})) as viewer:
        viewers.add_session("talk", 1, FaceSettings(), "zh")
        viewers.change_face("talk", FaceSettings(feeling=0.5))
        viewers.announce_acoustic_model("talk", "light")
        viewers.forward("talk", MessageKind.SPEECH, '{"type": "speech"}')
        viewers.forward("talk", MessageKind.END, '{"type": "end"}')
        for _ in range(2 * MAX_QUEUED):
            viewers.forward("talk", MessageKind.TEXT, '{"type": "phone"}')
            assert len(viewer.queue) <= MAX_QUEUED
        messages = [json.loads(message) for message in drain(viewer.queue)]
    types = [message["type"] for message in messages if message["type"] != "phone"]
    assert types == ["status", "shapes", "session", "face", "acoustic", "speech", "end"]


def test_weights_of_an_earlier_avatar_are_dropped_with_its_names() -> None:
    queue = ViewerQueue()
    queue.put(MessageKind.SHAPE_NAMES, "old names")
    queue.put(MessageKind.SHAPES, b"old weights")
    queue.put(MessageKind.SHAPE_NAMES, "new names")
    queue.put(MessageKind.SHAPES, b"new weights")
    for _ in range(MAX_QUEUED):
        queue.put(MessageKind.SOUND, b"")
    left = [message for message in drain(queue) if message]
    assert left == ["new names", b"new weights"]
