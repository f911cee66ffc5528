import numpy as np
import pytest

from kouxing.services.recognizer.front_end.resample import Resampler, to_16_khz
from kouxing.shared.errors import UserError

RATES = (8_000, 11_025, 16_000, 22_050, 24_000, 32_000, 44_100, 48_000)


def tone(rate_hz: int, hz: float = 440.0, seconds: float = 1.0) -> np.ndarray:
    return (0.5 * np.sin(2 * np.pi * hz * np.arange(int(rate_hz * seconds)) / rate_hz)).astype(
        np.float32
    )


@pytest.mark.parametrize("rate_hz", RATES)
def test_keeps_a_tone(rate_hz: int) -> None:
    resampled = to_16_khz(tone(rate_hz), rate_hz)
    assert abs(len(resampled) - 16_000) <= 1
    inner = slice(1000, 15_000)
    np.testing.assert_allclose(resampled[inner], tone(16_000)[inner], atol=2e-3)


def test_clips_16_khz_audio_and_passes_it_through() -> None:
    samples = np.array([0.0, 0.5, 3.0, -3.0], np.float32)
    np.testing.assert_array_equal(Resampler(16_000).accept_waveform(samples), [0.0, 0.5, 1.0, -1.0])
    column = Resampler(16_000).accept_waveform(samples[:, None])
    np.testing.assert_array_equal(column, [0.0, 0.5, 1.0, -1.0])


@pytest.mark.parametrize("rate_hz", [0, 7_999, 48_001, 192_000])
def test_rejects_rates_out_of_range(rate_hz: int) -> None:
    with pytest.raises(UserError, match=str(rate_hz)):
        Resampler(rate_hz)


def test_rejects_bad_samples() -> None:
    with pytest.raises(UserError, match="9 channels"):
        Resampler(16_000, 9)
    with pytest.raises(UserError, match="shape"):
        Resampler(16_000, 2).accept_waveform(np.zeros(10, np.float32))
    with pytest.raises(UserError, match="shape"):
        Resampler(16_000).accept_waveform(np.zeros((10, 2), np.float32))
    with pytest.raises(UserError, match="not finite"):
        Resampler(16_000).accept_waveform(np.array([np.nan], np.float32))
