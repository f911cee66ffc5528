"""Made-up recordings that a recognizer can learn: tones between silences."""

import numpy as np

from kouxing.training.neural.batches import Recording, Targets


def burst(start_s: float, end_s: float, whole_s: float, tone_hz: float = 1000.0) -> np.ndarray:
    """A tone in silence."""
    time_s = np.arange(round(whole_s * 16_000)) / 16_000
    inside = (time_s >= start_s) & (time_s < end_s)
    return (0.3 * np.sin(2 * np.pi * tone_hz * time_s) * inside).astype(np.float32)


def tones(seed: int) -> Recording:
    """Four tones one after the other, the states 1 to 4, between silences."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(4)
    pitches_hz = np.array([300.0, 700.0, 1500.0, 3500.0])[order]
    pieces = [burst(0.0, 0.2, 0.2, pitch_hz) for pitch_hz in pitches_hz]
    silence = np.zeros(1600, np.float32)
    sound = np.concatenate([silence, *pieces, silence]) + rng.normal(0, 1e-4, 16_000)
    starts = np.searchsorted([0.1, 0.3, 0.5, 0.7, 0.9], (np.arange(98) + 1.25) / 100, "right")
    states = np.array([0, *(1 + order), 0])
    samples = np.rint(32767 * sound).astype(np.int16)
    return Recording(samples=samples, targets=Targets.hard(states[starts]), weight=1.0)
