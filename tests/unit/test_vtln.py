import itertools

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
    """Glottal pulses through resonances, 80 Hz wide."""
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
    """Log energy 15, bands that fall off by 1 on both sides of a peak (band from 0)."""
    frame = np.concatenate([[15.0], 12.0 - np.abs(np.arange(NUM_BANDS) - peak)])
    return np.repeat(frame[None].astype(np.float32), num_frames, axis=0)


def voice(pitch_hz: float, num_frames: int, strength: float = 0.95) -> tuple[np.ndarray, ...]:
    return (
        np.full(num_frames, pitch_hz, np.float32),
        np.full(num_frames, strength, np.float32),
    )


def centre_hz(band: float) -> float:
    """Centre of a band, or of a place between two, counted from 0."""
    low, high = (1127 * np.log1p(hz / 700) for hz in (40.0, 7600.0))
    mel = low + (1 + band) * (high - low) / (NUM_BANDS + 1)
    return float(700 * np.expm1(mel / 1127))


@pytest.mark.parametrize("pitch_hz", [80.0, 110.0, 160.0, 220.0, 330.0])
@pytest.mark.parametrize("level", [0.5, 0.02])
def test_the_pitch_of_a_vowel(pitch_hz: float, level: float) -> None:
    measured_hz, strength = PitchTracker().accept_waveform(vowel(pitch_hz, level=level))
    np.testing.assert_allclose(measured_hz[4:], pitch_hz, rtol=0.03)
    assert (strength[4:] > VOICED_STRENGTH).all()
    assert strength.max() <= 1.0


def test_noise_and_silence_have_no_voice() -> None:
    _, strength = PitchTracker().accept_waveform(noise())
    assert (strength > VOICED_STRENGTH).mean() < 0.02
    pitch_hz, strength = PitchTracker().accept_waveform(np.zeros(16_000, np.float32))
    assert (pitch_hz == 0).all()
    assert (strength == 0).all()
    _, strength = PitchTracker().accept_waveform(noise() * np.float32(1e-4))
    assert strength.max() < VOICED_STRENGTH


def test_a_frame_of_pitch_is_ready_with_the_frame_of_features() -> None:
    log_mel, tracker = LogMel(), PitchTracker()
    sample = np.zeros(1, np.float32)
    for _ in range(400 + 160 * 3):
        num_frames = len(log_mel.accept_waveform(sample))
        pitch_hz, strength = tracker.accept_waveform(sample)
        assert len(pitch_hz) == len(strength) == num_frames


def test_a_frame_hears_up_to_its_end() -> None:
    """A change at sample t * 160 + 400 or later is none to frame t; one just before it is."""
    sound = vowel(150.0, seconds=0.2)
    end = 10 * 160 + 400
    whole = np.stack(PitchTracker().accept_waveform(sound))
    for change, same in ((end, True), (end - 8, False)):
        other = sound.copy()
        other[change:] += noise()[: len(sound) - change]
        frames = np.stack(PitchTracker().accept_waveform(other))
        np.testing.assert_array_equal(frames[:, :10], whole[:, :10])
        assert (frames[:, 10] == whole[:, 10]).all() == same


def chunks(num_samples: int, size: int | None) -> list[slice]:
    if size is None:
        cuts = np.sort(np.random.default_rng(3).integers(0, num_samples, 60))  # some are empty
        edges = [0, *cuts.tolist(), num_samples]
    else:
        edges = [*range(0, num_samples, size), num_samples]
    return [slice(*pair) for pair in itertools.pairwise(edges)]


@pytest.mark.parametrize("size", [1, 7, 160, 1000, None])
def test_any_chunks_give_the_same_bits(size: int | None) -> None:
    sound = np.concatenate([vowel(105.0, 0.15), noise(0.05), vowel(180.0, 0.1)])
    pitch_hz, strength = PitchTracker().accept_waveform(sound)
    log_mel = LogMel().accept_waveform(sound)
    warped = VocalTractNormalizer().warp(log_mel, pitch_hz, strength)
    assert (warped != log_mel).any()

    bank, tracker, vtln = LogMel(), PitchTracker(), VocalTractNormalizer()
    pitches, strengths, frames = [], [], []
    for chunk in chunks(len(sound), size):
        pitch, strong = tracker.accept_waveform(sound[chunk])
        pitches.append(pitch)
        strengths.append(strong)
        frames.append(vtln.warp(bank.accept_waveform(sound[chunk]), pitch, strong))
    np.testing.assert_array_equal(np.concatenate(pitches), pitch_hz)
    np.testing.assert_array_equal(np.concatenate(strengths), strength)
    np.testing.assert_array_equal(np.concatenate(frames), warped)


def test_a_low_voice_goes_up_with_time() -> None:
    vtln = VocalTractNormalizer()
    assert vtln.factor == 1.0
    factors = []
    for _ in range(10):
        vtln.warp(bands_with_a_peak(100, 20), *voice(110.0, 100))
        factors.append(vtln.factor)
    after_1_s = (REFERENCE_HZ / 110) ** (0.2 * 100 / 120)  # 20 frames are the reference's
    assert factors[0] == pytest.approx(after_1_s, abs=2e-3)
    assert factors == sorted(factors)
    assert factors[-1] == pytest.approx(np.exp(0.2 * np.log(REFERENCE_HZ / 110)), abs=5e-3)


def test_a_vowel_spoken_low_is_warped() -> None:
    sound = vowel(110.0, seconds=2.0)
    vtln = VocalTractNormalizer()
    vtln.warp(LogMel().accept_waveform(sound), *PitchTracker().accept_waveform(sound))
    assert vtln.factor == pytest.approx((REFERENCE_HZ / 110) ** (0.2 * 198 / 218), abs=4e-3)


def test_a_high_voice_keeps_every_bit() -> None:
    sound = vowel(240.0)
    log_mel = LogMel().accept_waveform(sound)
    vtln = VocalTractNormalizer()
    warped = vtln.warp(log_mel, *PitchTracker().accept_waveform(sound))
    np.testing.assert_array_equal(warped, log_mel)
    assert vtln.factor == 1.0
    assert not np.shares_memory(warped, log_mel)


def test_a_formant_moves_up_by_the_factor() -> None:
    log_mel = bands_with_a_peak(2000, 20)
    vtln = VocalTractNormalizer()
    warped = vtln.warp(log_mel, *voice(90.0, 2000))
    np.testing.assert_array_equal(warped[:, 0], log_mel[:, 0])
    for band in (25, 30, 35):  # on the falling side, where a value tells its place
        place = 20 + 12.0 - warped[-1, 1 + band]
        assert centre_hz(band) / centre_hz(place) == pytest.approx(vtln.factor, rel=1e-4)
    peak = warped[-1, 1:].argmax()
    assert centre_hz(int(peak)) / centre_hz(20) == pytest.approx(vtln.factor, rel=0.05)


def test_the_factor_has_a_limit() -> None:
    vtln = VocalTractNormalizer()
    warped = vtln.warp(bands_with_a_peak(2000, 20), *voice(40.0, 2000))
    assert vtln.factor == MAX_FACTOR
    assert np.isfinite(warped).all()


def test_frames_without_voice_do_not_move_the_mean() -> None:
    vtln = VocalTractNormalizer()
    vtln.warp(bands_with_a_peak(50, 20), *voice(110.0, 50))
    before = vtln.factor
    vtln.warp(bands_with_a_peak(50, 20), *voice(300.0, 50, strength=0.7))
    vtln.warp(bands_with_a_peak(50, 20), *voice(0.0, 50, strength=0.0))
    assert vtln.factor == before


def test_another_speaker_is_followed() -> None:
    vtln = VocalTractNormalizer()
    vtln.warp(bands_with_a_peak(20_000, 20), *voice(110.0, 20_000))
    vtln.warp(bands_with_a_peak(3000, 20), *voice(330.0, 3000))
    assert vtln.factor == 1.0


def test_reset_forgets() -> None:
    vtln = VocalTractNormalizer()
    log_mel = bands_with_a_peak(100, 20)
    first = vtln.warp(log_mel, *voice(110.0, 100))
    vtln.reset()
    assert vtln.factor == 1.0
    np.testing.assert_array_equal(vtln.warp(log_mel, *voice(110.0, 100)), first)


def test_shapes_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match="shapes"):
        VocalTractNormalizer().warp(bands_with_a_peak(3, 20), *voice(110.0, 2))
