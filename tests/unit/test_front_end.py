"""The recognizer's front ends: PCM, resampling, features, pitch and vocal-tract length."""

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.front_end import resample
from kouxing.services.recognizer.front_end.features import (
    NUM_BANDS,
    NUM_STATIC,
    RunningMean,
    append_deltas,
)
from kouxing.services.recognizer.front_end.pitch import PitchTracker
from kouxing.services.recognizer.front_end.resample import Resampler, to_16_khz
from kouxing.services.recognizer.front_end.slices import level_db
from kouxing.services.recognizer.front_end.vtln import REFERENCE_HZ, VocalTractNormalizer
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS, WhisperMel, mel_bands
from kouxing.shared.audio.pcm import decode_pcm


def test_int16_samples_are_scaled_to_one() -> None:
    pcm = np.array([[-32768, 16384], [0, 32767]], "<i2").tobytes()
    expected = [[-1.0, 0.5], [0.0, 32767 / 32768]]
    np.testing.assert_allclose(decode_pcm(pcm, "s16le", 2), expected)


def test_float_samples_above_one_are_clipped() -> None:
    pcm = np.array([2.0, -3.0, 0.25], "<f4").tobytes()
    np.testing.assert_array_equal(decode_pcm(pcm, "f32le", 1)[:, 0], [1.0, -1.0, 0.25])


def test_level_is_the_rms_in_decibels_of_full_scale() -> None:
    sine = np.sin(np.arange(16000) * 0.1).astype(np.float32)
    assert level_db(sine) == pytest.approx(-3.01, abs=0.01)
    assert level_db(np.zeros(10, np.float32)) == -120.0
    assert level_db(np.zeros(0, np.float32)) == -120.0


RATES = (8_000, 11_025, 16_000, 22_050, 24_000, 32_000, 44_100, 47_999, 48_000)


def tone(rate_hz: int, hz: float = 440.0, seconds: float = 1.0) -> np.ndarray:
    return (0.5 * np.sin(2 * np.pi * hz * np.arange(int(rate_hz * seconds)) / rate_hz)).astype(
        np.float32
    )


@pytest.mark.parametrize("rate_hz", RATES)
def test_resampling_keeps_a_tone(rate_hz: int) -> None:
    resampled = to_16_khz(tone(rate_hz), rate_hz)
    assert abs(len(resampled) - 16_000) <= 1
    inner = slice(1000, 15_000)
    np.testing.assert_allclose(resampled[inner], tone(16_000)[inner], atol=2e-3)


@pytest.mark.parametrize("rate_hz", [8_001, 44_101, 47_999])
def test_the_filter_of_an_odd_rate_is_small(rate_hz: int) -> None:
    """A row for each of 16,000 phases would take seconds, while all sessions wait."""
    assert len(resample._filter_table(rate_hz)) <= 641


def test_interpolated_filters_are_accurate(monkeypatch: pytest.MonkeyPatch) -> None:
    rate_hz, num_phases = 12_345, 3_200
    noise = np.random.default_rng(0).uniform(-1, 1, 4_000).astype(np.float32)
    resampled = to_16_khz(noise, rate_hz)
    monkeypatch.setattr(resample, "_MAX_PHASES", num_phases)
    monkeypatch.setattr(resample, "_filter_table", resample._filter_table.__wrapped__)
    np.testing.assert_allclose(resampled, to_16_khz(noise, rate_hz), atol=1e-5)


def test_clips_16_khz_audio_and_passes_it_through() -> None:
    samples = np.array([0.0, 0.5, 3.0, -3.0], np.float32)
    np.testing.assert_array_equal(Resampler(16_000).accept_waveform(samples), [0.0, 0.5, 1.0, -1.0])
    column = Resampler(16_000).accept_waveform(samples[:, None])
    np.testing.assert_array_equal(column, [0.0, 0.5, 1.0, -1.0])


def test_differences_of_a_line_and_a_parabola() -> None:
    """HTK book, eq. 5.16: the regression's slope is exact for a line."""
    time = np.arange(40, dtype=np.float32)
    for half_width in (1, 2):
        line = np.repeat((3 * time)[:, None], NUM_STATIC, axis=1)
        inner = append_deltas(line, half_width)[2 * half_width : -2 * half_width]
        np.testing.assert_allclose(inner[:, NUM_STATIC : 2 * NUM_STATIC], 3.0, rtol=1e-5)
        np.testing.assert_allclose(inner[:, 2 * NUM_STATIC :], 0.0, atol=1e-4)
        parabola = np.repeat((time**2)[:, None], NUM_STATIC, axis=1)
        inner = append_deltas(parabola, half_width)[2 * half_width : -2 * half_width]
        np.testing.assert_allclose(inner[:, 2 * NUM_STATIC :], 2.0, rtol=1e-3)


def test_live_mean_adapts_from_the_prior_to_the_speaker() -> None:
    rng = np.random.default_rng(0)
    speaker = rng.normal(5, 1, NUM_STATIC)
    static = speaker + rng.normal(0, 1, (3000, NUM_STATIC))
    features = np.concatenate([static, rng.normal(size=(3000, 26))], axis=1).astype(np.float32)
    mean = RunningMean(np.zeros(NUM_STATIC, np.float32))
    normalized = mean.normalize(features)
    assert normalized[0, 1:NUM_STATIC].mean() > 3  # the prior dominates
    assert np.abs(normalized[-1000:, :NUM_STATIC].mean(axis=0)).max() < 0.6
    np.testing.assert_array_equal(normalized[:, NUM_STATIC:], features[:, NUM_STATIC:])
    # the mean persists until reset
    assert abs(mean.normalize(features[:50])[:, 1:NUM_STATIC].mean()) < 1
    mean.reset()
    np.testing.assert_array_equal(mean.normalize(features), normalized)


def test_feature_frames_match_the_definition() -> None:
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


def bands_with_a_peak(num_frames: int, peak: int) -> np.ndarray:
    """Return frames with log energy 15, whose bands fall by 1 per band on both sides of a peak."""
    frame = np.concatenate([[15.0], 12.0 - np.abs(np.arange(NUM_BANDS) - peak)])
    return np.repeat(frame[None].astype(np.float32), num_frames, axis=0)


def vtln_voice(pitch_hz: float, num_frames: int, strength: float = 0.95) -> tuple[np.ndarray, ...]:
    return (np.full(num_frames, pitch_hz, np.float32), np.full(num_frames, strength, np.float32))


def center_hz(band: float) -> float:
    """Return the center of a band, counted from 0, or of a place between two bands."""
    low, high = (1127 * np.log1p(hz / 700) for hz in (40.0, 7600.0))
    mel = low + (1 + band) * (high - low) / (NUM_BANDS + 1)
    return float(700 * np.expm1(mel / 1127))


def test_warps_a_low_voice_more_over_time() -> None:
    vtln = VocalTractNormalizer()
    factors = []
    for _ in range(10):
        vtln.warp(bands_with_a_peak(100, 20), *vtln_voice(110.0, 100))
        factors.append(vtln.factor)
    after_1_s = (REFERENCE_HZ / 110) ** (0.2 * 100 / 120)  # the reference weighs 20 frames
    assert factors[0] == pytest.approx(after_1_s, abs=2e-3)
    assert factors == sorted(factors)
    assert factors[-1] == pytest.approx(np.exp(0.2 * np.log(REFERENCE_HZ / 110)), abs=5e-3)


def test_the_warp_moves_formants_up_by_its_factor() -> None:
    log_mel = bands_with_a_peak(2000, 20)
    vtln = VocalTractNormalizer()
    warped = vtln.warp(log_mel, *vtln_voice(90.0, 2000))
    np.testing.assert_array_equal(warped[:, 0], log_mel[:, 0])
    for band in (25, 30, 35):  # where the bands fall, the value gives the place
        place = 20 + 12.0 - warped[-1, 1 + band]
        assert center_hz(band) / center_hz(place) == pytest.approx(vtln.factor, rel=1e-4)
    peak = warped[-1, 1:].argmax()
    assert center_hz(int(peak)) / center_hz(20) == pytest.approx(vtln.factor, rel=0.05)


RATE_HZ, SLICE_SAMPLES = 16_000, 320


def sung(frequency_hz: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return ten harmonics of a frequency, given for every sample."""
    phase = 2.0 * np.pi * np.cumsum(frequency_hz) / RATE_HZ
    tones = [np.sin(number * phase) / number for number in range(1, 11)]
    return np.asarray(0.1 * np.sum(tones, axis=0), np.float32)


def pitches(samples: NDArray[np.float32], num_before: int = 0) -> NDArray[np.float64]:
    pitch = PitchTracker(num_before)
    return np.array([pitch.track(part) for part in samples.reshape(-1, SLICE_SAMPLES)])


def noise(num_samples: int) -> NDArray[np.float32]:
    return np.random.default_rng(1).normal(0.0, 0.01, num_samples).astype(np.float32)


@pytest.mark.parametrize("frequency_hz", [80.0, 120.0, 220.0, 330.0])
def test_tracks_a_constant_pitch(frequency_hz: float) -> None:
    pitch_hz = pitches(sung(np.full(RATE_HZ, frequency_hz)))[10:]
    np.testing.assert_allclose(pitch_hz, frequency_hz, rtol=0.03)


def test_tracks_a_rising_pitch_but_not_noise_or_silence() -> None:
    rising = sung(np.linspace(150.0, 250.0, RATE_HZ))
    silent = np.zeros(RATE_HZ // 2, np.float32)
    pitch_hz = pitches(np.concatenate([silent, rising, noise(RATE_HZ)]))
    assert not pitch_hz[:25].any()
    expected_hz = np.linspace(150.0, 250.0, 50)
    np.testing.assert_allclose(pitch_hz[35:73], expected_hz[10:48], rtol=0.05)
    assert np.count_nonzero(pitch_hz[80:]) < 5


def test_a_tracker_that_starts_later_soon_agrees() -> None:
    samples = sung(np.linspace(150.0, 250.0, 4 * RATE_HZ)) + noise(4 * RATE_HZ)
    expected, later = pitches(samples), pitches(samples[70 * SLICE_SAMPLES :], num_before=70)
    np.testing.assert_array_equal(later[80:], expected[150:])
