"""Changes to log-mel bands against the same changes to the samples."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from services.recognizer.features import LOG_FLOOR, LogMel
from shared.audio_file import read_audio
from training.augmentation import Augmentation

pytestmark = pytest.mark.unit

DEMO = Path(__file__).parents[2] / "shared" / "demo"
HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]


def test_hard_augmentation_is_repeatable_and_finite() -> None:
    rng = np.random.default_rng(0)
    log_mel = rng.normal(14, 2, (80, 41)).astype(np.float32)
    for _ in range(40):
        change = Augmentation.draw_hard(rng)
        out = change.apply(log_mel)
        assert out.shape == (len(change.positions(80)), 41)
        assert np.isfinite(out).all()
        assert out.min() >= LOG_FLOOR
        np.testing.assert_array_equal(out, change.apply(log_mel))


def test_a_room_fills_the_pause_after_a_sound() -> None:
    log_mel = np.full((60, 41), 8.0, np.float32)
    log_mel[10:20] = 18.0
    dry = Augmentation(
        speed=1.0, warp=1.0, level=0.0, noise_below=30.0, noise_tilt=0.0,
        colour=(0.0,) * 6, decay=0.0, narrow=False, seed=0,
    )  # fmt: skip
    wet = Augmentation(
        speed=1.0, warp=1.0, level=0.0, noise_below=30.0, noise_tilt=0.0,
        colour=(0.0,) * 6, decay=0.9, narrow=False, seed=0,
    )  # fmt: skip
    assert wet.apply(log_mel)[22:30].mean() > dry.apply(log_mel)[22:30].mean() + 3


def changed(log_mel: np.ndarray, **how: Any) -> np.ndarray:
    """A recording with nothing changed but what is named."""
    plain: dict[str, Any] = {
        "speed": 1.0, "warp": 1.0, "level": 0.0, "noise_below": 30.0, "noise_tilt": 0.0,
        "colour": (0.0,) * 6, "decay": 0.0, "narrow": False, "seed": 0, "noise_slope": 0.0,
    }  # fmt: skip
    return Augmentation(**{**plain, **how}).apply(log_mel)


def log_mel_of(samples: np.ndarray) -> np.ndarray:
    return LogMel().accept_waveform(samples.astype(np.float32))


@pytest.mark.parametrize("slope", [0.0, -1.0, -2.0])
def test_noise_is_as_noise_in_the_samples(slope: float) -> None:
    frequency = np.fft.rfftfreq(len(HELLO), 1 / 16_000)
    density = np.where(frequency < 40, 0.0, np.maximum(frequency, 40.0) ** slope)
    white = np.random.default_rng(0).normal(size=len(HELLO))
    noise = np.fft.irfft(np.fft.rfft(white) * np.sqrt(density))
    noise *= np.sqrt(0.1 * np.mean(HELLO**2) / np.mean(noise**2))
    speech, heard = log_mel_of(HELLO), log_mel_of(HELLO + noise)
    made = changed(speech, noise_slope=slope, noise_below=np.log(10.0))
    np.testing.assert_allclose(made.mean(axis=0), heard.mean(axis=0), atol=0.6)
    assert abs(made.mean() - heard.mean()) < 0.35
    # the cross term: where speech is 10 to 20 dB above the noise, its bands waver all the same
    above = speech - log_mel_of(noise).mean(axis=0)
    clear = (above > 2.3) & (above < 4.6)
    assert np.std((made - speech)[clear]) == pytest.approx(np.std((heard - speech)[clear]), rel=0.6)


def test_a_line_takes_off_what_a_filter_would() -> None:
    line = butter(8, [300, 3400], "bandpass", fs=16_000, output="sos")
    speech, heard = log_mel_of(HELLO), log_mel_of(sosfilt(line, HELLO))
    made = changed(speech, lowest_hz=300.0, highest_hz=3400.0, skirt=16.0, stop=14.0)
    off, made_off = (heard - speech).mean(axis=0), (made - speech).mean(axis=0)
    np.testing.assert_allclose(made_off[6:], off[6:], atol=1.5)
    assert (made_off[1:5] < -2).all()  # below the line the window lets the first harmonics leak
    assert (off[1:5] < -2).all()
    assert abs(made_off[0] - off[0]) < 0.5  # log energy


def test_hard_augmentation_holds_hiss_rumble_and_telephones() -> None:
    rng = np.random.default_rng(0)
    drawn = [Augmentation.draw_hard(rng) for _ in range(500)]
    slopes = [one.noise_slope for one in drawn if one.noise_slope is not None]
    assert min(slopes) < -2 < 0 < max(slopes)
    assert 0.08 < np.mean([one.lowest_hz > 200 for one in drawn]) < 0.2
    assert 0.5 < np.mean([one.noise_below < 7 for one in drawn]) < 0.7
