import numpy as np
import pytest

from kouxing.services.recognizer.front_end.features import NUM_BANDS
from kouxing.services.recognizer.front_end.vtln import REFERENCE_HZ, VocalTractNormalizer


def bands_with_a_peak(num_frames: int, peak: int) -> np.ndarray:
    """Return frames with log energy 15, whose bands fall by 1 per band on both sides of a peak."""
    frame = np.concatenate([[15.0], 12.0 - np.abs(np.arange(NUM_BANDS) - peak)])
    return np.repeat(frame[None].astype(np.float32), num_frames, axis=0)


def voice(pitch_hz: float, num_frames: int, strength: float = 0.95) -> tuple[np.ndarray, ...]:
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
