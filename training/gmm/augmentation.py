"""Augmentation of log-mel bands for the Gaussian mixtures: voices, rooms and lines.

It works on the bands and takes seconds for an hour of speech. Neural training augments samples
instead (:mod:`kouxing.training.neural.augmentation`). The band energies of speech and noise add up.
Warping the band axis changes the vocal tract's length (Jaitly and Hinton 2013, "Vocal tract length
perturbation"). Stretching the time axis changes the speed.

======== =================================================== ===============
symbol   meaning                                             shape
======== =================================================== ===============
power    energy of a frame, then of each of its bands        (frames, 41)
noise    energies of the noise: spectrum(k) * scatter        (frames, 41)
======== =================================================== ===============
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from kouxing.services.recognizer.front_end.features import (
    BAND_HZ,
    BAND_MEL,
    HIGHEST_HZ,
    LOG_FLOOR,
    NUM_BANDS,
    mel_of,
)

_WET = 0.5  # energy of a room's tail relative to the direct sound
_NARROW_HZ = (300.0, 3400.0)
_NARROW_LOSS = 8.0  # outside a telephone's band, natural log of power


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """One augmentation of a recording; equal values give equal results."""

    speed: float  # above 1 is faster
    warp: float  # factor of all frequencies
    level: float  # added to all log energies
    noise_below: float  # level of the speech above the noise, natural log of power
    noise_tilt: float  # slope of the noise over the bands, natural log
    color: tuple[float, ...]  # added to the bands; values at equal mel distances
    decay: float  # fraction of the energy that remains in the next frame; 0: no reverberation
    narrow: bool  # whether to simulate a telephone line, 300 to 3400 Hz
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Augmentation:
        """Draw an augmentation at random."""
        return cls(
            speed=float(rng.uniform(0.9, 1.1)),
            warp=float(rng.uniform(0.88, 1.12)),
            level=float(rng.uniform(-5.0, 1.0)),
            noise_below=float(rng.uniform(5.0, 14.0)),
            noise_tilt=float(rng.uniform(-4.0, 1.0)),
            color=tuple(rng.normal(0.0, 0.7, 6).tolist()),
            decay=float(rng.uniform(0.0, 0.6)) if rng.random() < 0.5 else 0.0,
            narrow=bool(rng.random() < 0.05),
            seed=int(rng.integers(2**31)),
        )

    def positions(self, num_frames: int) -> NDArray[np.float64]:
        """Return the position of each new frame among the ``num_frames`` original frames."""
        return np.linspace(0, num_frames - 1, max(2, round(num_frames / self.speed)))

    def apply(self, log_mel: NDArray[np.float32]) -> NDArray[np.float32]:
        """Augment a recording: shape (frames, 41) to (frames / speed, 41)."""
        rng = np.random.default_rng(self.seed)
        at = self.positions(len(log_mel))
        low = np.minimum(at.astype(int), len(log_mel) - 2)
        fraction = (at - low)[:, None].astype(np.float32)
        frames = (1 - fraction) * log_mel[low] + fraction * log_mel[low + 1]
        bands, energy = self._warped(frames[:, 1:]), frames[:, 0]
        at_color = np.linspace(0, NUM_BANDS - 1, len(self.color))
        bands = bands + np.interp(np.arange(NUM_BANDS), at_color, self.color).astype(np.float32)
        power = np.exp(np.concatenate([energy[:, None], bands], axis=1))
        if self.decay:  # the room adds a tail
            tail = lfilter([0.0, 1 - self.decay], [1.0, -self.decay], power, axis=0)
            power += _WET * self.decay * tail
        power += self._noise(power, rng)
        out = np.log(power) + self.level
        if self.narrow:
            outside = (_NARROW_HZ[0] > BAND_HZ) | (_NARROW_HZ[1] < BAND_HZ)
            out[:, 1:][:, outside] -= _NARROW_LOSS
        return np.asarray(np.maximum(out, LOG_FLOOR).astype(np.float32))

    def _noise(self, power: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a noise relative to the recording's level, energies of shape (frames, 41)."""
        loud = np.percentile(power, 90, axis=0).mean()
        spectrum = np.linspace(0, self.noise_tilt, NUM_BANDS)
        noise = np.exp(np.concatenate([[0.0], spectrum]) - self.noise_below) * loud
        noise[0] = noise[1:].mean() * np.median(power[:, 0] / power[:, 1:].mean(axis=1))
        scatter = rng.gamma(4.0, 0.25, power.shape)  # models the fluctuation of a band's energy
        return np.asarray(noise * scatter)

    def _warped(self, bands: NDArray[np.float32]) -> NDArray[np.float32]:
        """Warp the frequency axis, shape (frames, 40) to the same."""
        source = mel_of(np.minimum(BAND_HZ / self.warp, HIGHEST_HZ))
        at = np.clip(np.interp(source, BAND_MEL, np.arange(NUM_BANDS)), 0, NUM_BANDS - 1)
        low = np.minimum(at.astype(int), NUM_BANDS - 2)
        fraction = (at - low).astype(np.float32)
        return np.asarray((1 - fraction) * bands[:, low] + fraction * bands[:, low + 1])
