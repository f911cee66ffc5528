"""A client's audio: conversion to PCM; what it sends, resends and drops."""

import ctypes
from array import array

import numpy as np
import pytest
from kouxing_client import KouxingError
from kouxing_client.audio import ANSWER_LIMITS_S, RESEND_S, AudioStream, check_channels, to_pcm

CHUNK = 1600  # samples: 100 ms


def stream_of(num_chunks: int) -> AudioStream:
    """Return a stream whose chunks are sent at intervals of 100 ms."""
    stream = AudioStream(16000, is_paced=True)
    for number in range(num_chunks):
        stream.add({}, CHUNK, number / 10)
        sent(stream)
    return stream


def sent(stream: AudioStream) -> list[int]:
    """Send what is unsent; return the sequence numbers."""
    return [message["sequence"] for message in stream.unsent()]


def test_numbers_messages_and_counts_media_time_at_16_khz() -> None:
    stream = AudioStream(48000, is_paced=True)
    for _ in range(2):
        stream.add({}, 4800, 0.0)
    stream.skip(2400)
    stream.add({"last": True}, 0, 0.0)
    messages = list(stream.unsent())
    assert [message["sequence"] for message in messages] == [1, 2, 3]
    assert [message["media_time"] for message in messages] == [0, 1600, 4000]
    assert sent(stream) == []


def test_keeps_acknowledged_audio_for_a_limited_time() -> None:
    stream = stream_of(149)
    stream.acknowledge(139, 15.0)  # the others are on their way
    stream.add({}, CHUNK, 15.0)
    stream.move(1, 15.0)
    assert sent(stream) == list(range(139 - round(RESEND_S / 0.1), 151))


def test_flushed_audio_is_not_sent_but_the_end_is() -> None:
    stream = stream_of(3)
    stream.add({}, CHUNK, 0.3)
    assert stream.flush() == 4
    assert sent(stream) == []
    assert stream.num_unacknowledged == 0
    stream.add({"last": True}, 0, 0.4)
    stream.flush()
    stream.move(2, 0.5)
    assert sent(stream) == [5]


def test_the_wait_for_an_acknowledgement_starts_again_after_a_flush() -> None:
    stream = stream_of(3)
    stream.flush()
    stream.add({}, CHUNK, 100.0)
    assert not stream.is_stuck(100.0 + ANSWER_LIMITS_S[0])
    assert stream.is_stuck(100.1 + ANSWER_LIMITS_S[0])


FLOATS = [0.0, 0.5, -1.0, 2.0]
INTEGERS = array("h", [0, 16384, -32768, 32767])
BEYOND_1 = r"16-bit integers .*, or floats within ±1, not "
OTHER_FORMAT = r"16-bit integers .* byte order, not the format"
NO_NUMBERS = "audio must be bytes or numbers, not "


@pytest.mark.parametrize(
    "audio",
    [
        INTEGERS.tobytes(),
        INTEGERS,
        list(INTEGERS),
        iter(INTEGERS),
        FLOATS,
        np.array(FLOATS, np.float32).reshape(2, 2),
        np.array(INTEGERS, np.int16),
        (ctypes.c_int16 * 4)(*INTEGERS),
        (ctypes.c_float * 4)(*FLOATS),
        np.frombuffer(b"-" + INTEGERS.tobytes(), np.int16, offset=1),
    ],
    ids=lambda audio: type(audio).__name__,
)
def test_audio_may_be_bytes_or_numbers(audio: object) -> None:
    assert to_pcm(audio, "s16le") == INTEGERS.tobytes()
    assert to_pcm(FLOATS, "f32le") == array("f", FLOATS).tobytes()


@pytest.mark.parametrize("encoding", ["s16le", "f32le"])
@pytest.mark.parametrize(
    ("audio", "message"),
    [
        ([0, -16384, 32768], BEYOND_1),  # usually 16-bit samples in an array of another type
        ([10**400], BEYOND_1),
        (np.array([0.0, -900.0], np.float32), BEYOND_1),
        (np.array([np.nan, 0.5], np.float32), BEYOND_1),
        ([0.5, np.nan], BEYOND_1),
        *(
            (np.zeros(2, kind), OTHER_FORMAT)
            for kind in ("?", "i4", "i8", ">i2", ">f4", "f2", "c8")
        ),
        (None, NO_NUMBERS),
        ("text", NO_NUMBERS),
        ([b"bytes"], NO_NUMBERS),
    ],
)
def test_rejects_other_audio(audio: object, message: str, encoding: str) -> None:
    with pytest.raises(KouxingError, match=message):
        to_pcm(audio, encoding)


def test_small_integers_in_a_list_are_quiet() -> None:
    assert to_pcm([0, 1, -1], "s16le") == array("h", [0, 1, -1]).tobytes()
    assert to_pcm([0, 1, -1], "f32le") == array("f", [0, 1 / 32768, -1 / 32768]).tobytes()


def test_rejects_an_array_with_another_number_of_channels() -> None:
    for audio in (b"", FLOATS, np.zeros(4), np.zeros((4, 2))):
        check_channels(audio, 2)
    check_channels(np.zeros((4, 1)), 1)
    with pytest.raises(KouxingError, match=r"shape \(4, 2\), .* num_channels=1; push .* \(n, 1\)"):
        check_channels(np.zeros((4, 2)), 1)
    for shape in ((2, 4), (4, 2, 1)):
        with pytest.raises(KouxingError, match="num_channels=2"):
            check_channels(np.zeros(shape), 2)
