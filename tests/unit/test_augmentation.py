"""Augmentation of log-mel bands."""

import numpy as np
import pytest

from kouxing.services.recognizer.front_end.features import LOG_FLOOR
from kouxing.training.gmm.augmentation import Augmentation

pytestmark = pytest.mark.unit


def changed(log_mel: np.ndarray, **how: float) -> np.ndarray:
    """Change nothing but what is named."""
    plain = {"speed": 1.0, "warp": 1.0, "level": 0.0, "noise_below": 30.0, "decay": 0.0}
    return Augmentation(
        **(plain | how), noise_tilt=0.0, color=(0.0,) * 6, narrow=False, seed=0
    ).apply(log_mel)


def test_augmentation_is_repeatable_and_above_the_floor() -> None:
    rng = np.random.default_rng(0)
    log_mel = rng.normal(14, 2, (80, 41)).astype(np.float32)
    for _ in range(40):
        change = Augmentation.draw(rng)
        out = change.apply(log_mel)
        assert out.shape == (len(change.positions(80)), 41)
        assert np.isfinite(out).all()
        assert out.min() >= LOG_FLOOR
        np.testing.assert_array_equal(out, change.apply(log_mel))


def test_a_room_fills_the_pause_after_a_sound() -> None:
    log_mel = np.full((60, 41), 8.0, np.float32)
    log_mel[10:20] = 18.0
    dry, wet = changed(log_mel), changed(log_mel, decay=0.9)
    assert wet[22:30].mean() > dry[22:30].mean() + 3


def test_a_warp_moves_a_peak_up() -> None:
    log_mel = np.full((10, 41), 8.0, np.float32)
    log_mel[:, 20] = 18.0
    warped = changed(log_mel, warp=1.12)
    assert warped[5, 1:].argmax() > 19
    assert changed(log_mel, warp=1.0)[5, 1:].argmax() == 19
