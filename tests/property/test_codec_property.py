from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
from tests.samples import SAMPLES

pytestmark = pytest.mark.property


@given(st.lists(st.binary(max_size=200), max_size=4))
def test_rejects_garbage(parts: list[bytes]) -> None:
    with pytest.raises(BadMessage):
        decode(parts)


@given(
    st.sampled_from(SAMPLES),
    st.sampled_from(SAMPLES),
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
EVENTS: st.SearchStrategy[SoundEvent] = st.one_of(
    st.builds(
        Phone,
        index=st.integers(0, 2**53),
        symbol=st.from_regex("[a-z]{1,4}", fullmatch=True),
        onset_s=TIMES,
        duration_s=TIMES,
        confidence=st.floats(0, 1),
        final=st.booleans(),
    ),
    st.builds(SpeechChange, active=st.booleans(), time_s=TIMES),
    st.builds(Progress, time_s=TIMES, level_db=st.floats(-200, 20)),
    st.builds(EndOfSound, time_s=TIMES),
)


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
        faps=st.lists(
            st.floats(width=32, allow_nan=False), min_size=len(MOUTH_FAPS), max_size=len(MOUTH_FAPS)
        ).map(lambda faps: np.array(faps, np.float32)),
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
