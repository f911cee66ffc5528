from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.codec import BadMessage, decode, encode
from shared.messages import VERSION, AudioChunk, Message
from tests.samples import SAMPLES

pytestmark = pytest.mark.property


@given(st.lists(st.binary(max_size=200), max_size=4))
def test_garbage_is_refused_and_nothing_else_happens(parts: list[bytes]) -> None:
    with pytest.raises(BadMessage):
        decode(parts)


@given(st.sampled_from(SAMPLES), st.data())
def test_a_damaged_message_is_refused_or_still_a_valid_one(
    message: Message, data: st.DataObject
) -> None:
    topic, body = encode(message)
    position = data.draw(st.integers(0, len(body) - 1))
    damaged = bytearray(body)
    damaged[position] = data.draw(st.integers(0, 255))
    try:
        read = decode([topic, bytes(damaged)])
    except BadMessage:
        return
    assert (type(read), read.session, read.version) == (type(message), message.session, VERSION)


@given(st.binary(max_size=1000), st.integers(0, 2**53), st.integers(0, 2**53))
def test_audio_survives_the_wire(pcm: bytes, sequence: int, media_time: int) -> None:
    chunk = AudioChunk(
        session="s",
        token="t",
        pcm=pcm,
        sequence=sequence,
        media_time=media_time,
    )
    assert decode(encode(chunk)) == chunk
