"""Other voices, rooms and lines from the same recording, made on its log-mel bands.

Working on log-mel bands (instead of samples) makes a copy of an hour in seconds. The band
energies of speech and noise add; their cross terms, zero on average, are replaced by the noise's
own scatter. Warping the band axis lengthens or shortens the vocal tract (Jaitly and Hinton 2013,
"Vocal tract length perturbation"); stretching the time axis is a change of speed.

======== ===================================================== ===============
symbol   meaning                                               shape
======== ===================================================== ===============
P        energies of the recording, power                      (frames, 41)
N        energies of the noise: gain(t) * spectrum(k) * scatter (frames, 41)
======== ===================================================== ===============
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from services.recognizer.features import LOG_FLOOR, NUM_BANDS

_LOWEST_HZ, _HIGHEST_HZ = 40.0, 7600.0
_WET = 0.5  # energy of a room's tail against the direct sound


def _mel(hz: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1127.0 * np.log1p(hz / 700.0)


def _hz(mel: NDArray[np.float64]) -> NDArray[np.float64]:
    return 700.0 * np.expm1(mel / 1127.0)


def _over_bands(values: tuple[float, ...]) -> NDArray[np.float32]:
    """Values at equal mel distances, interpolated to all bands, shape (40,)."""
    at = np.linspace(0, NUM_BANDS - 1, len(values))
    return np.interp(np.arange(NUM_BANDS), at, values).astype(np.float32)


_LOWEST_MEL, _HIGHEST_MEL = _mel(np.array([_LOWEST_HZ, _HIGHEST_HZ]))
_BAND_MEL = np.linspace(_LOWEST_MEL, _HIGHEST_MEL, NUM_BANDS + 2)[1:-1]
_BAND_HZ = _hz(_BAND_MEL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """One way to change a recording; the same values give the same result."""

    speed: float  # above 1 is faster
    warp: float  # frequencies are multiplied by this
    level: float  # added to all log energies
    noise_below: float  # noise this far below the speech, natural log of power
    noise_tilt: float  # slope of the noise over the bands, natural log of power
    colour: tuple[float, ...]  # added to the bands, values at equal mel distances
    decay: float  # share of the energy that stays for the next frame, 0 is a dry room
    narrow: bool  # a telephone line: 300 to 3400 Hz
    seed: int
    highest_hz: float = 8000.0  # a codec or a poor microphone lets nothing higher through
    noise_peaks: tuple[float, ...] = ()  # added to the noise's bands, like ``colour``
    flutter: float = 0.0  # the noise's gain changes by this from breath to breath, natural log
    knocks: float = 0.0  # share of the frames in which something knocks

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

    @classmethod
    def draw_hard(cls, rng: np.random.Generator) -> Augmentation:
        """Draw one at random, up to what a network still learns from: noise at 0 to 30 dB."""
        return cls(
            speed=float(np.exp(rng.uniform(-0.22, 0.22))),
            warp=float(np.exp(rng.uniform(-0.13, 0.13))),
            level=float(rng.uniform(-5.0, 2.0)),
            noise_below=float(rng.uniform(0.0, 7.0) if rng.random() < 0.6 else 12.0),
            noise_tilt=float(rng.uniform(-5.0, 1.5)),
            colour=tuple(rng.normal(0.0, rng.uniform(0.3, 1.2), 6).tolist()),
            decay=float(rng.uniform(0.3, 0.92)) if rng.random() < 0.5 else 0.0,
            narrow=bool(rng.random() < 0.07),
            seed=int(rng.integers(2**31)),
            highest_hz=float(rng.uniform(3800.0, 8000.0)) if rng.random() < 0.3 else 8000.0,
            noise_peaks=tuple(rng.normal(0.0, 1.0, 12).tolist()),
            flutter=float(rng.uniform(0.3, 1.5)) if rng.random() < 0.4 else 0.0,
            knocks=float(rng.uniform(0.005, 0.05)) if rng.random() < 0.2 else 0.0,
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
            outside = (_BAND_HZ < 300.0) | (_BAND_HZ > 3400.0)
            out[:, 1:][:, outside] -= 8.0
        out[:, 1:][:, self.highest_hz < _BAND_HZ] -= 6.0
        floored: NDArray[np.float32] = np.maximum(out, LOG_FLOOR).astype(np.float32)
        return floored

    def _noise(self, power: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Energies of a noise that fits the recording's level, shape (frames, 41)."""
        num_frames = len(power)
        loud = np.percentile(power, 90, axis=0).mean()
        spectrum = np.linspace(0, self.noise_tilt, NUM_BANDS)
        if self.noise_peaks:
            spectrum = spectrum + _over_bands(self.noise_peaks)
        noise = np.exp(np.concatenate([[0.0], spectrum]) - self.noise_below) * loud
        noise[0] = noise[1:].mean() * np.median(power[:, 0] / power[:, 1:].mean(axis=1))
        gain = np.ones(num_frames)
        if self.flutter:
            knots = rng.normal(0.0, self.flutter, 2 + num_frames // 15)
            gain = np.exp(np.interp(np.arange(num_frames) / 15, np.arange(len(knots)), knots))
        if self.knocks:
            hits = (rng.random(num_frames) < self.knocks) * rng.uniform(1.0, 30.0, num_frames)
            gain = gain + lfilter([1.0], [1.0, -0.4], hits)
        scatter = rng.gamma(4.0, 0.25, power.shape)  # as a band's energy does
        return np.asarray(gain[:, None] * noise * scatter)

    def _warped(self, bands: NDArray[np.float32]) -> NDArray[np.float32]:
        source = _mel(np.minimum(_BAND_HZ / self.warp, _HIGHEST_HZ))
        at = np.clip(np.interp(source, _BAND_MEL, np.arange(NUM_BANDS)), 0, NUM_BANDS - 1)
        low = np.minimum(at.astype(int), NUM_BANDS - 2)
        share = (at - low).astype(np.float32)
        warped: NDArray[np.float32] = (1 - share) * bands[:, low] + share * bands[:, low + 1]
        return warped
