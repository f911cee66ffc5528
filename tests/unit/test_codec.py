"""Messages are encoded and decoded; everything else is rejected with a reason."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kouxing.shared.clock import to_seconds
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import (
    EndOfSound,
    LipPositions,
    Phone,
    Progress,
    SoundEvent,
    SpeechChange,
)
from kouxing.shared.wire.codec import BadMessage, decode, encode
from kouxing.shared.wire.events import event_of, message_of
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import OpenSession
from tests.samples import SAMPLES

PHONE: dict[str, Any] = {"index": 0, "symbol": "a", "duration": 1, "final": True}


def parts_of(kind: str, session: str = "s", **fields: object) -> list[bytes]:
    return [f"{kind}/{session}/".encode(), msgpack.packb({"session": session, **fields})]


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ([b"done/s/"], "parts"),
        ([b"done", b"\x80"], "topic"),
        ([b"dance/s/", b"\x80"], "kind"),
        ([b"done/s/x", b"\x80"], "kind"),
        ([b"done/s/", b"\xc1garbage"], "body"),
        ([b"done/s/", b"\x91" * 5000], "body"),
        (parts_of("done"), "body"),
        (parts_of("done", request=5), "body"),
        (parts_of("done", request="r", media_time=-1), "body"),
        (parts_of("open-session", request="r", sample_rate_hz=192000), "body"),
        (parts_of("open-session", request="r", encoding="mp3"), "body"),
        (parts_of("open-session", session="a b", request="r"), "body"),
        *((parts_of("phone", **PHONE, confidence=c), "body") for c in (math.nan, 1.5, -0.1)),
        (parts_of("fap-frame", values=b"short", mask=b"\0" * 9), "body"),
        (parts_of("done", request="r", version=1), "version"),
        (parts_of("open", request="r", version=1), "version"),
        (parts_of("open", request="r"), "kind"),
        (parts_of("done", request="r", version=0), "body"),
        ([b"done/other/", msgpack.packb({"session": "s", "request": "r"})], "topic"),
    ],
)
def test_rejects_bad_messages_with_a_reason(parts: list[bytes], reason: str) -> None:
    with pytest.raises(BadMessage) as caught:
        decode(parts)
    assert caught.value.reason == reason


def test_rejects_another_version_and_says_what_to_do() -> None:
    version = 2
    with pytest.raises(BadMessage, match="upgrade the sender") as caught:
        decode(parts_of("open", request="r", version=version))
    assert caught.value.version == version
    assert f"'open' is a message of protocol version {version}" in str(caught.value)
    assert "proto/PROTOCOL.md" in str(caught.value)


def test_fields_with_defaults_are_optional_and_unknown_fields_are_ignored() -> None:
    message = decode(parts_of("open-session", request="r", color="red"))
    assert message == OpenSession(session="s", request="r")


@given(st.lists(st.binary(max_size=200), max_size=4))
def test_rejects_garbage(parts: list[bytes]) -> None:
    with pytest.raises(BadMessage):
        decode(parts)


@given(
    st.sampled_from([*SAMPLES.values()]),
    st.sampled_from([*SAMPLES.values()]),
    st.floats(0, 1, exclude_max=True),
    st.one_of(st.binary(max_size=40), st.integers(1, 60_000).map(lambda n: b"\x81\xa1x" * n)),
)
def test_rejects_a_damaged_message_or_reads_it_the_same_twice(
    message: Message, other: Message, place: float, inserted: bytes
) -> None:
    label, body = encode(message)
    at = int(place * len(body))
    for damaged in (
        body[:at],
        body[:at] + inserted + body[at:],
        body[:at] + inserted + body[at + len(inserted) :],
        body[:at] + encode(other)[1] + body[at:],
    ):
        for topic in (label, encode(other)[0]):
            try:
                read = encode(decode([topic, damaged]))
            except BadMessage:
                continue
            assert encode(decode(read)) == read


TIMES = st.integers(0, 2**40).map(to_seconds)  # two years
NUMBERS = st.integers(0, 2**53)
SYMBOLS = st.from_regex("[a-z]{1,4}", fullmatch=True)
EVENTS: st.SearchStrategy[SoundEvent] = st.one_of(
    st.builds(Phone, index=NUMBERS, symbol=SYMBOLS, onset_s=TIMES, duration_s=TIMES,
              confidence=st.floats(0, 1), final=st.booleans()),
    st.builds(SpeechChange, active=st.booleans(), time_s=TIMES),
    st.builds(Progress, time_s=TIMES, level_db=st.floats(-200, 20)),
    st.builds(EndOfSound, time_s=TIMES),
)  # fmt: skip


@given(EVENTS)
def test_converts_an_event_to_a_message_and_back(event: SoundEvent) -> None:
    message = message_of(event)
    assert decode(encode(message)) == message
    assert event_of(message) == event


@given(
    st.builds(
        LipPositions,
        time_s=TIMES,
        delay_s=st.integers(-16_000, 16_000).map(to_seconds),
        faps=arrays(np.float32, len(MOUTH_FAPS), elements=st.floats(width=32, allow_nan=False)),
        closure=st.floats(0, 1),
        lip_to_teeth=st.floats(0, 1),
    )
)
def test_converts_a_lip_frame_to_a_message_and_back(frame: LipPositions) -> None:
    message = message_of(frame)
    assert decode(encode(message)) == message
    read = event_of(message)
    assert isinstance(read, LipPositions)
    np.testing.assert_array_equal(read.faps, frame.faps)
    assert replace(read, faps=frame.faps) == frame
