"""What a browser sends is checked field by field."""

from __future__ import annotations

import json
import struct

import pytest

from kouxing.services.gateway import wire
from kouxing.services.gateway.sound_format import SoundFormat
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_models import MAX_MOUTH_PROFILE_BYTES, LipModelName

pytestmark = pytest.mark.unit


def test_binary_messages_have_an_aligned_header() -> None:
    message = wire.binary(wire.FAP_TYPE, 7, 2**40 + 1, b"payload!")

    assert struct.unpack_from("<B3xId", message) == (1, 7, 2**40 + 1)
    assert message[16:] == b"payload!"


def test_a_hello_describes_the_audio() -> None:
    hello = wire.parse_hello('{"sample_rate_hz": 44100, "num_channels": 2, "encoding": "f32le"}')

    assert hello.sound == SoundFormat(sample_rate_hz=44100, num_channels=2, encoding="f32le")
    assert hello.sound.frame_bytes == 8
    assert wire.parse_hello('{"sample_rate_hz": 8000}').sound.frame_bytes == 2
    assert hello.mouth_profile == b""
    assert wire.parse_hello('{"sample_rate_hz": 8000, "voice": "YWJj"}').mouth_profile == b"abc"


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({}, "sample_rate_hz"),
        ({"sample_rate_hz": True}, "sample_rate_hz"),
        ({"sample_rate_hz": 16000.0}, "sample_rate_hz"),
        ({"sample_rate_hz": 96000}, "sample_rate_hz"),
        ({"sample_rate_hz": 16000, "num_channels": 3}, "num_channels"),
        ({"sample_rate_hz": 16000, "encoding": "opus"}, "encoding"),
        ({"sample_rate_hz": 16000, "encoding": ["s16le"]}, "encoding"),
        ({"sample_rate_hz": 16000, "voice": "no base64!"}, "voice"),
        ({"sample_rate_hz": 16000, "voice": "ü"}, "voice"),
        ({"sample_rate_hz": 16000, "voice": ["YWJj"]}, "voice"),
        ({"sample_rate_hz": 16000, "voice": "AAAA" * (MAX_MOUTH_PROFILE_BYTES // 3 + 1)}, "voice"),
        ([1], "object"),
    ],
)
def test_a_wrong_hello_names_its_field(fields: object, named: str) -> None:
    with pytest.raises(UserError, match=named):
        wire.parse_hello(json.dumps(fields))


def test_a_microphone_may_interrupt_and_leave_samples_out() -> None:
    flush, skip = wire.parse_command('{"flush": true}'), wire.parse_command('{"skip": 960}')

    assert (flush.flush, flush.num_skipped) == (True, 0)
    assert (skip.flush, skip.num_skipped) == (False, 960)
    assert flush.lips == skip.lips == ""


@pytest.mark.parametrize("lips", [str(name) for name in LipModelName])
def test_a_microphone_may_choose_its_lips(lips: str) -> None:
    assert wire.parse_command(json.dumps({"lips": lips})).lips == lips


@pytest.mark.parametrize("lips", ["muscles", 1, None, ["learnt"]])
def test_there_are_no_other_lips(lips: object) -> None:
    with pytest.raises(UserError, match="lips must be one of dynamic-visemes, learnt"):
        wire.parse_command(json.dumps({"lips": lips}))


@pytest.mark.parametrize("num_skipped", [-1, 1.5, True, "1", wire.MAX_SKIPPED + 1])
def test_what_is_left_out_must_be_a_number_of_samples(num_skipped: object) -> None:
    with pytest.raises(UserError, match="skip must be a whole number"):
        wire.parse_command(json.dumps({"skip": num_skipped}))


@pytest.mark.parametrize("message", ["", "{", "[" * 100_000, "null", '"text"'])
def test_what_is_no_object_is_refused(message: str) -> None:
    with pytest.raises(UserError, match="JSON object"):
        wire.parse_object(message)
