"""Whisper's front end, compared with its definition."""

import numpy as np
import pytest

from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS, WhisperMel, mel_bands


def test_frames_match_the_definition() -> None:
    sound = np.random.default_rng(0).normal(0, 0.1, 3000)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(400) / 400)
    expected = []
    for start in range(0, len(sound) - 399, 160):
        power = np.abs(np.fft.rfft(sound[start : start + 400] * window)) ** 2
        expected.append((np.log10(np.maximum(power @ mel_bands(), 1e-7)) + 4) / 4)
    bands = WhisperMel().accept_waveform(sound.astype(np.float32))
    np.testing.assert_allclose(bands, expected, atol=1e-5)


def test_bands_match_slaney() -> None:
    """Check Slaney's mels: 66.7 Hz below 1 kHz, 6.9 % above it; every triangle has the area 1."""
    bands = mel_bands()
    assert bands.shape == (201, NUM_MELS)
    center_hz = bands.argmax(axis=0) * 40
    assert center_hz[NUM_MELS - 1] == pytest.approx(7700, abs=40)
    assert (np.diff(center_hz) >= 0).all()
    wide = bands[:, -20:].sum(axis=0) * 40  # lines are 40 Hz apart
    np.testing.assert_allclose(wide, 1, atol=0.03)
