from __future__ import annotations

import numpy as np
import pytest

from kouxing.services.recognizer.front_end.pcm import (
    BadAudio,
    level_db,
    pcm16_of,
    samples_of,
)


def test_scales_int16_to_one() -> None:
    pcm = np.array([[-32768, 16384], [0, 32767]], "<i2").tobytes()
    expected = [[-1.0, 0.5], [0.0, 32767 / 32768]]
    np.testing.assert_allclose(samples_of(pcm, "s16le", 2), expected)


def test_clips_floats_above_one() -> None:
    pcm = np.array([2.0, -3.0, 0.25], "<f4").tobytes()
    np.testing.assert_array_equal(samples_of(pcm, "f32le", 1)[:, 0], [1.0, -1.0, 0.25])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_rejects_samples_that_are_not_finite(value: float) -> None:
    with pytest.raises(BadAudio, match="NaN"):
        samples_of(np.array([0.0, value], "<f4").tobytes(), "f32le", 1)


@pytest.mark.parametrize(
    ("num_bytes", "encoding", "channels"), [(3, "s16le", 1), (6, "s16le", 2), (5, "f32le", 1)]
)
def test_rejects_half_frames(num_bytes: int, encoding: str, channels: int) -> None:
    with pytest.raises(BadAudio, match="is not a multiple of"):
        samples_of(b"\0" * num_bytes, encoding, channels)


def test_int16_round_trip() -> None:
    values = np.array([-32768, -1, 0, 1, 32767], "<i2")
    assert pcm16_of(samples_of(values.tobytes(), "s16le", 1)[:, 0]) == values.tobytes()


def test_level() -> None:
    sine = np.sin(np.arange(16000) * 0.1).astype(np.float32)
    assert level_db(sine) == pytest.approx(-3.01, abs=0.01)
    assert level_db(np.zeros(10, np.float32)) == -120.0
    assert level_db(np.zeros(0, np.float32)) == -120.0
