"""Other voices, rooms and lines from the same recording, made on its log-mel bands.

Working on log-mel bands (instead of samples) makes a copy of an hour in seconds. The band
energies of speech and noise add. Warping the band axis lengthens or shortens the vocal tract
(Jaitly and Hinton 2013, "Vocal tract length perturbation"); stretching the time axis is a change of
speed.

======== =================================================== ===============
symbol   meaning                                             shape
======== =================================================== ===============
power    energies of the recording and its log energy's      (frames, 41)
noise    energies of the noise: spectrum(k) * scatter        (frames, 41)
======== =================================================== ===============
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from services.recognizer.features import (
    BAND_HZ,
    BAND_MEL,
    HIGHEST_HZ,
    LOG_FLOOR,
    NUM_BANDS,
    mel_of,
)

_WET = 0.5  # energy of a room's tail against the direct sound


def _over_bands(values: tuple[float, ...]) -> NDArray[np.float32]:
    """Values at equal mel distances, interpolated to all bands, shape (40,)."""
    at = np.linspace(0, NUM_BANDS - 1, len(values))
    return np.interp(np.arange(NUM_BANDS), at, values).astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """One way to change a recording; the same values give the same result."""

    speed: float  # above 1 is faster
    warp: float  # frequencies are multiplied by this
    level: float  # added to all log energies
    noise_below: float  # noise this far below the speech, natural log of power
    noise_tilt: float  # slope of the noise over the bands, natural log
    colour: tuple[float, ...]  # added to the bands, values at equal mel distances
    decay: float  # share of the energy that stays for the next frame, 0 is a dry room
    narrow: bool  # a telephone line: 300 to 3400 Hz
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Augmentation:
        """Draw one at random."""
        return cls(
            speed=float(rng.uniform(0.9, 1.1)),
            warp=float(rng.uniform(0.88, 1.12)),
            level=float(rng.uniform(-5.0, 1.0)),
            noise_below=float(rng.uniform(5.0, 14.0)),
            noise_tilt=float(rng.uniform(-4.0, 1.0)),
            colour=tuple(rng.normal(0.0, 0.7, 6).tolist()),
            decay=float(rng.uniform(0.0, 0.6)) if rng.random() < 0.5 else 0.0,
            narrow=bool(rng.random() < 0.05),
            seed=int(rng.integers(2**31)),
        )

    def positions(self, num_frames: int) -> NDArray[np.float64]:
        """Where each new frame lies in a recording of so many frames."""
        return np.linspace(0, num_frames - 1, max(2, round(num_frames / self.speed)))

    def apply(self, log_mel: NDArray[np.float32]) -> NDArray[np.float32]:
        """Change a recording: shape (frames, 41) to (frames / speed, 41)."""
        rng = np.random.default_rng(self.seed)
        at = self.positions(len(log_mel))
        low = np.minimum(at.astype(int), len(log_mel) - 2)
        share = (at - low)[:, None].astype(np.float32)
        frames = (1 - share) * log_mel[low] + share * log_mel[low + 1]
        bands, energy = self._warped(frames[:, 1:]), frames[:, 0]
        bands = bands + _over_bands(self.colour)
        power = np.exp(np.concatenate([energy[:, None], bands], axis=1))
        if self.decay:  # the room answers with a tail: half of it counts
            tail = lfilter([0.0, 1 - self.decay], [1.0, -self.decay], power, axis=0)
            power += _WET * self.decay * tail
        power += self._noise(power, rng)
        out = np.log(power) + self.level
        if self.narrow:
            outside = (BAND_HZ < 300.0) | (BAND_HZ > 3400.0)
            out[:, 1:][:, outside] -= 8.0
        floored: NDArray[np.float32] = np.maximum(out, LOG_FLOOR).astype(np.float32)
        return floored

    def _noise(self, power: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float64]:
        """Energies of a noise that fits the recording's level, shape (frames, 41)."""
        loud = np.percentile(power, 90, axis=0).mean()
        spectrum = np.linspace(0, self.noise_tilt, NUM_BANDS)
        noise = np.exp(np.concatenate([[0.0], spectrum]) - self.noise_below) * loud
        noise[0] = noise[1:].mean() * np.median(power[:, 0] / power[:, 1:].mean(axis=1))
        scatter = rng.gamma(4.0, 0.25, power.shape)  # as a band's energy does
        return np.asarray(noise * scatter)

    def _warped(self, bands: NDArray[np.float32]) -> NDArray[np.float32]:
        source = mel_of(np.minimum(BAND_HZ / self.warp, HIGHEST_HZ))
        at = np.clip(np.interp(source, BAND_MEL, np.arange(NUM_BANDS)), 0, NUM_BANDS - 1)
        low = np.minimum(at.astype(int), NUM_BANDS - 2)
        share = (at - low).astype(np.float32)
        warped: NDArray[np.float32] = (1 - share) * bands[:, low] + share * bands[:, low + 1]
        return warped
