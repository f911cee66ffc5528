"""The pitch of synthetic voices."""

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.front_end.pitch import PitchTracker

RATE_HZ, SLICE = 16_000, 320


def voice(frequency_hz: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return ten harmonics of a frequency, given for every sample."""
    phase = 2.0 * np.pi * np.cumsum(frequency_hz) / RATE_HZ
    tones = [np.sin(number * phase) / number for number in range(1, 11)]
    return np.asarray(0.1 * np.sum(tones, axis=0), np.float32)


def pitches(samples: NDArray[np.float32], num_before: int = 0) -> NDArray[np.float64]:
    pitch = PitchTracker(num_before)
    return np.array([pitch.track(part) for part in samples.reshape(-1, SLICE)])


def noise(num_samples: int) -> NDArray[np.float32]:
    return np.random.default_rng(1).normal(0.0, 0.01, num_samples).astype(np.float32)


@pytest.mark.parametrize("frequency_hz", [80.0, 120.0, 220.0, 330.0])
def test_tracks_a_constant_pitch(frequency_hz: float) -> None:
    pitch_hz = pitches(voice(np.full(RATE_HZ, frequency_hz)))[10:]
    np.testing.assert_allclose(pitch_hz, frequency_hz, rtol=0.03)


def test_tracks_a_rising_pitch_but_not_noise_or_silence() -> None:
    rising = voice(np.linspace(150.0, 250.0, RATE_HZ))
    silent = np.zeros(RATE_HZ // 2, np.float32)
    pitch_hz = pitches(np.concatenate([silent, rising, noise(RATE_HZ)]))
    assert not pitch_hz[:25].any()
    expected_hz = np.linspace(150.0, 250.0, 50)
    np.testing.assert_allclose(pitch_hz[35:73], expected_hz[10:48], rtol=0.05)
    assert np.count_nonzero(pitch_hz[80:]) < 5


def test_a_tracker_that_starts_later_soon_agrees() -> None:
    samples = voice(np.linspace(150.0, 250.0, 4 * RATE_HZ)) + noise(4 * RATE_HZ)
    whole, later = pitches(samples), pitches(samples[70 * SLICE :], num_before=70)
    np.testing.assert_array_equal(later[80:], whole[150:])
