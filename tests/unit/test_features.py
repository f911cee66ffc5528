import numpy as np
import pytest

from kouxing.services.recognizer.front_end.features import (
    LOG_FLOOR,
    NUM_BANDS,
    NUM_FEATURES,
    NUM_STATIC,
    Differences,
    LiveMean,
    LogMel,
    cepstra,
    with_differences,
)

pytestmark = pytest.mark.unit


def tone(hz: float, seconds: float = 0.5, level: float = 0.3) -> np.ndarray:
    time_s = np.arange(int(16_000 * seconds)) / 16_000
    return (level * np.sin(2 * np.pi * hz * time_s)).astype(np.float32)


def test_a_tone_is_loudest_in_its_band() -> None:
    low = LogMel().accept_waveform(tone(200.0))[5, 1:].argmax()
    high = LogMel().accept_waveform(tone(4000.0))[5, 1:].argmax()
    mel_share = np.log1p(4000 / 700) / np.log1p(7600 / 700)
    assert low < 6
    assert abs(high / NUM_BANDS - mel_share) < 0.05


def test_digital_silence_is_finite() -> None:
    log_mel = LogMel().accept_waveform(np.zeros(4000, np.float32))
    assert (log_mel == np.float32(LOG_FLOOR)).all()
    assert np.abs(cepstra(log_mel)[:, 1:]).max() < 1e-4  # a flat spectrum has no shape


def test_level_affects_only_the_energy() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.1, 8000).astype(np.float32)
    loud, soft = (cepstra(LogMel().accept_waveform(noise * gain)) for gain in (1.0, 0.1))
    np.testing.assert_allclose(loud[:, 0] - soft[:, 0], 2 * np.log(10), atol=1e-2)
    np.testing.assert_allclose(loud[:, 1:], soft[:, 1:], atol=1e-2)


def test_differences_of_a_line_and_a_parabola() -> None:
    """HTK book, eq. 5.16: the regression's slope is exact for a line."""
    time = np.arange(40, dtype=np.float32)
    for half_width in (1, 2):
        line = np.repeat((3 * time)[:, None], NUM_STATIC, axis=1)
        inner = with_differences(line, half_width)[2 * half_width : -2 * half_width]
        np.testing.assert_allclose(inner[:, NUM_STATIC : 2 * NUM_STATIC], 3.0, rtol=1e-5)
        np.testing.assert_allclose(inner[:, 2 * NUM_STATIC :], 0.0, atol=1e-4)
        parabola = np.repeat((time**2)[:, None], NUM_STATIC, axis=1)
        inner = with_differences(parabola, half_width)[2 * half_width : -2 * half_width]
        np.testing.assert_allclose(inner[:, 2 * NUM_STATIC :], 2.0, rtol=1e-3)


@pytest.mark.parametrize("half_width", [1, 2])
def test_differences_look_ahead_as_stated(half_width: int) -> None:
    static = np.random.default_rng(0).normal(size=(30, NUM_STATIC)).astype(np.float32)
    differences = Differences(half_width)
    assert differences.look_ahead_frames == 2 * half_width
    ready = differences.append(static)
    assert len(ready) == 30 - 2 * half_width
    whole = np.concatenate([ready, differences.finish()])
    np.testing.assert_array_equal(whole, with_differences(static, half_width))


def test_live_mean_adapts_from_the_prior_to_the_speaker() -> None:
    rng = np.random.default_rng(0)
    speaker = rng.normal(5, 1, NUM_STATIC)
    static = speaker + rng.normal(0, 1, (3000, NUM_STATIC))
    features = np.concatenate([static, rng.normal(size=(3000, 26))], axis=1).astype(np.float32)
    mean = LiveMean(np.zeros(NUM_STATIC, np.float32))
    normalized = mean.normalize(features)
    assert normalized[0, 1:NUM_STATIC].mean() > 3  # the prior dominates
    assert np.abs(normalized[-1000:, :NUM_STATIC].mean(axis=0)).max() < 0.6
    np.testing.assert_array_equal(normalized[:, NUM_STATIC:], features[:, NUM_STATIC:])
    # the mean persists until reset
    assert abs(mean.normalize(features[:50])[:, 1:NUM_STATIC].mean()) < 1
    mean.reset()
    np.testing.assert_array_equal(mean.normalize(features), normalized)


def test_the_mean_ignores_quiet_frames() -> None:
    speech = np.full((200, NUM_FEATURES), 20.0, np.float32)
    pause = np.full((200, NUM_FEATURES), 1.0, np.float32)
    with_pause, without = LiveMean(np.zeros(13, np.float32)), LiveMean(np.zeros(13, np.float32))
    with_pause.normalize(speech)
    with_pause.normalize(pause)
    without.normalize(speech)
    np.testing.assert_array_equal(with_pause.normalize(speech[:1]), without.normalize(speech[:1]))
