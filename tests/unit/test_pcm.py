import numpy as np
import pytest

from kouxing.services.recognizer.front_end.pcm import level_db, samples_of


def test_scales_int16_to_one() -> None:
    pcm = np.array([[-32768, 16384], [0, 32767]], "<i2").tobytes()
    expected = [[-1.0, 0.5], [0.0, 32767 / 32768]]
    np.testing.assert_allclose(samples_of(pcm, "s16le", 2), expected)


def test_clips_floats_above_one() -> None:
    pcm = np.array([2.0, -3.0, 0.25], "<f4").tobytes()
    np.testing.assert_array_equal(samples_of(pcm, "f32le", 1)[:, 0], [1.0, -1.0, 0.25])


def test_level() -> None:
    sine = np.sin(np.arange(16000) * 0.1).astype(np.float32)
    assert level_db(sine) == pytest.approx(-3.01, abs=0.01)
    assert level_db(np.zeros(10, np.float32)) == -120.0
    assert level_db(np.zeros(0, np.float32)) == -120.0
