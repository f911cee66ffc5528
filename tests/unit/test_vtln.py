import numpy as np
import pytest

from kouxing.services.recognizer.front_end.features import NUM_BANDS, LogMel
from kouxing.services.recognizer.front_end.vtln import (
    MAX_FACTOR,
    REFERENCE_HZ,
    VOICED_STRENGTH,
    PitchTracker,
    VocalTractNormalizer,
)

pytestmark = pytest.mark.unit

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


def noise(seconds: float = 1.0) -> np.ndarray:
    samples = np.random.default_rng(0).normal(0, 0.1, int(16_000 * seconds))
    return samples.astype(np.float32)


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


@pytest.mark.parametrize("pitch_hz", [80.0, 110.0, 160.0, 220.0, 330.0])
@pytest.mark.parametrize("level", [0.5, 0.02])
def test_tracks_the_pitch_of_a_vowel(pitch_hz: float, level: float) -> None:
    measured_hz, strength = PitchTracker().accept_waveform(vowel(pitch_hz, level=level))
    np.testing.assert_allclose(measured_hz[4:], pitch_hz, rtol=0.03)
    assert (strength[4:] > VOICED_STRENGTH).all()
    assert strength.max() <= 1.0


def test_noise_and_silence_are_unvoiced() -> None:
    _, strength = PitchTracker().accept_waveform(noise())
    assert (strength > VOICED_STRENGTH).mean() < 0.02
    pitch_hz, strength = PitchTracker().accept_waveform(np.zeros(16_000, np.float32))
    assert (pitch_hz == 0).all()
    assert (strength == 0).all()
    _, strength = PitchTracker().accept_waveform(noise() * np.float32(1e-4))
    assert strength.max() < VOICED_STRENGTH


def test_pitch_depends_on_audio_up_to_the_end_of_the_frame() -> None:
    sound = vowel(150.0, seconds=0.2)
    end = 10 * 160 + 400
    whole = np.stack(PitchTracker().accept_waveform(sound))
    for change, same in ((end, True), (end - 8, False)):
        other = sound.copy()
        other[change:] += noise()[: len(sound) - change]
        frames = np.stack(PitchTracker().accept_waveform(other))
        np.testing.assert_array_equal(frames[:, :10], whole[:, :10])
        assert (frames[:, 10] == whole[:, 10]).all() == same


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


def test_does_not_change_a_high_voice() -> None:
    sound = vowel(240.0)
    log_mel = LogMel().accept_waveform(sound)
    vtln = VocalTractNormalizer()
    warped = vtln.warp(log_mel, *PitchTracker().accept_waveform(sound))
    np.testing.assert_array_equal(warped, log_mel)
    assert vtln.factor == 1.0
    assert not np.shares_memory(warped, log_mel)


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


def test_limits_the_factor() -> None:
    vtln = VocalTractNormalizer()
    vtln.warp(bands_with_a_peak(2000, 20), *voice(40.0, 2000))
    assert vtln.factor == MAX_FACTOR


def test_ignores_unvoiced_frames() -> None:
    vtln = VocalTractNormalizer()
    vtln.warp(bands_with_a_peak(50, 20), *voice(110.0, 50))
    before = vtln.factor
    vtln.warp(bands_with_a_peak(50, 20), *voice(300.0, 50, strength=0.7))
    vtln.warp(bands_with_a_peak(50, 20), *voice(0.0, 50, strength=0.0))
    assert vtln.factor == before


def test_adapts_to_another_speaker() -> None:
    vtln = VocalTractNormalizer()
    vtln.warp(bands_with_a_peak(20_000, 20), *voice(110.0, 20_000))
    vtln.warp(bands_with_a_peak(3000, 20), *voice(330.0, 3000))
    assert vtln.factor == 1.0
