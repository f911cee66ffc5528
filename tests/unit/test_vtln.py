import numpy as np
import pytest

from kouxing.services.recognizer.front_end.features import NUM_BANDS
from kouxing.services.recognizer.front_end.vtln import (
    REFERENCE_HZ,
    VOICED_STRENGTH,
    PitchTracker,
    VocalTractNormalizer,
)

FORMANTS_HZ = (600.0, 1500.0, 2500.0)


def vowel(pitch_hz: float, seconds: float = 1.0, level: float = 0.1) -> np.ndarray:
    """Return glottal pulses through resonances, 80 Hz wide."""
    num_samples = int(16_000 * seconds)
    pulses = np.zeros(num_samples)
    pulses[np.arange(0, num_samples, 16_000 / pitch_hz).astype(int)] = 1.0
    time_s = np.arange(800) / 16_000
    ring = np.zeros(800)
    for index, hz in enumerate(FORMANTS_HZ):
        ring += np.exp(-np.pi * 80 * time_s) * np.sin(2 * np.pi * hz * time_s) / (1 + index)
    sound = np.convolve(pulses, ring)[:num_samples]
    return np.asarray(level * sound / np.abs(sound).max(), dtype=np.float32)


def bands_with_a_peak(num_frames: int, peak: int) -> np.ndarray:
    """Return frames with log energy 15, whose bands fall by 1 per band on both sides of a peak."""
    frame = np.concatenate([[15.0], 12.0 - np.abs(np.arange(NUM_BANDS) - peak)])
    return np.repeat(frame[None].astype(np.float32), num_frames, axis=0)


def voice(pitch_hz: float, num_frames: int, strength: float = 0.95) -> tuple[np.ndarray, ...]:
    return (
        np.full(num_frames, pitch_hz, np.float32),
        np.full(num_frames, strength, np.float32),
    )


def center_hz(band: float) -> float:
    """Return the center of a band, counted from 0, or of a place between two bands."""
    low, high = (1127 * np.log1p(hz / 700) for hz in (40.0, 7600.0))
    mel = low + (1 + band) * (high - low) / (NUM_BANDS + 1)
    return float(700 * np.expm1(mel / 1127))


@pytest.mark.parametrize(("pitch_hz", "level"), [(80.0, 0.5), (160.0, 0.02), (330.0, 0.5)])
def test_tracks_the_pitch_of_a_vowel(pitch_hz: float, level: float) -> None:
    measured_hz, strength = PitchTracker().accept_waveform(vowel(pitch_hz, level=level))
    np.testing.assert_allclose(measured_hz[4:], pitch_hz, rtol=0.03)
    assert (strength[4:] > VOICED_STRENGTH).all()
    assert strength.max() <= 1.0


def test_warps_a_low_voice_more_over_time() -> None:
    vtln = VocalTractNormalizer()
    factors = []
    for _ in range(10):
        vtln.warp(bands_with_a_peak(100, 20), *voice(110.0, 100))
        factors.append(vtln.factor)
    after_1_s = (REFERENCE_HZ / 110) ** (0.2 * 100 / 120)  # the reference weighs 20 frames
    assert factors[0] == pytest.approx(after_1_s, abs=2e-3)
    assert factors == sorted(factors)
    assert factors[-1] == pytest.approx(np.exp(0.2 * np.log(REFERENCE_HZ / 110)), abs=5e-3)


def test_moves_formants_up_by_the_factor() -> None:
    log_mel = bands_with_a_peak(2000, 20)
    vtln = VocalTractNormalizer()
    warped = vtln.warp(log_mel, *voice(90.0, 2000))
    np.testing.assert_array_equal(warped[:, 0], log_mel[:, 0])
    for band in (25, 30, 35):  # where the bands fall, the value gives the place
        place = 20 + 12.0 - warped[-1, 1 + band]
        assert center_hz(band) / center_hz(place) == pytest.approx(vtln.factor, rel=1e-4)
    peak = warped[-1, 1:].argmax()
    assert center_hz(int(peak)) / center_hz(20) == pytest.approx(vtln.factor, rel=0.05)
