from __future__ import annotations

import numpy as np
import pytest

from kouxing.services.recognizer.front_end.pcm import (
    SLICE,
    BadAudio,
    level_db,
    pcm16_of,
    samples_of,
    slices,
)

pytestmark = pytest.mark.unit


def test_int16_is_scaled_to_one() -> None:
    pcm = np.array([[-32768, 16384], [0, 32767]], "<i2").tobytes()
    expected = [[-1.0, 0.5], [0.0, 32767 / 32768]]
    np.testing.assert_allclose(samples_of(pcm, "s16le", 2), expected)


def test_float_beyond_one_is_clipped() -> None:
    pcm = np.array([2.0, -3.0, 0.25], "<f4").tobytes()
    np.testing.assert_array_equal(samples_of(pcm, "f32le", 1)[:, 0], [1.0, -1.0, 0.25])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_refused(value: float) -> None:
    with pytest.raises(BadAudio, match="NaN"):
        samples_of(np.array([0.0, value], "<f4").tobytes(), "f32le", 1)


@pytest.mark.parametrize(
    ("num_bytes", "encoding", "channels"), [(3, "s16le", 1), (6, "s16le", 2), (5, "f32le", 1)]
)
def test_half_frames_are_refused(num_bytes: int, encoding: str, channels: int) -> None:
    with pytest.raises(BadAudio, match="not a whole number"):
        samples_of(b"\0" * num_bytes, encoding, channels)


def test_int16_round_trip() -> None:
    values = np.array([-32768, -1, 0, 1, 32767], "<i2")
    assert pcm16_of(samples_of(values.tobytes(), "s16le", 1)[:, 0]) == values.tobytes()


def test_level() -> None:
    sine = np.sin(np.arange(16000) * 0.1).astype(np.float32)
    assert level_db(sine) == pytest.approx(-3.01, abs=0.01)
    assert level_db(np.zeros(10, np.float32)) == -120.0
    assert level_db(np.zeros(0, np.float32)) == -120.0


@pytest.mark.parametrize("chunk", [1, 7, 160, 320, 441, 1000, 5000])
def test_slices_end_at_the_same_places_for_every_chunking(chunk: int) -> None:
    samples = np.arange(5000, dtype=np.float32)
    ends = set()
    for begin in range(0, len(samples), chunk):
        position = begin
        for part in slices(samples[begin : begin + chunk], begin):
            np.testing.assert_array_equal(part, samples[position : position + len(part)])
            position += len(part)
            ends.add(position)
    assert ends >= set(range(SLICE, 5001, SLICE))
