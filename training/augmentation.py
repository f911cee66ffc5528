"""Other voices, rooms and lines from the same recording, made on its log-mel bands.

Working on log-mel bands (instead of samples) makes a copy of an hour in seconds. The band
energies of speech and noise add. Warping the band axis lengthens or shortens the vocal tract
(Jaitly and Hinton 2013, "Vocal tract length perturbation"); stretching the time axis is a change of
speed.

======== =================================================== ===============
symbol   meaning                                             shape
======== =================================================== ===============
P        energies of the recording, power                    (frames, 41)
N        mean energies of the noise: gain(t) * spectrum(k)   (frames, 41)
S        power density of the noise's sound, f^slope * peaks (40,)
w, H     width of a band in Hz; gain of the pre-emphasis     (40,)
K        independent pairs in a band's energy                (41,)
======== =================================================== ===============

A noise is a sound, so its bands follow from its power density as the front end (a window, the
pre-emphasis 1 - 0.97/z, triangular bands that widen) would hear it:

    N_0 = energy,  N_k = energy * c * H_k * S_k w_k / sum S w

The speech's spectrum stays while the noise's has a random phase: the energy of their sum has the
mean P + N and the variance (N^2 + 2 P N) / K, cross term included (a non-central chi-square).
Without pre-emphasis and cross term, noise would spare the upper bands, where it does most harm.
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
    LOWEST_HZ,
    NUM_BANDS,
    SAMPLE_RATE_HZ,
    mel_of,
)

_WET = 0.5  # energy of a room's tail against the direct sound
_BANDS_TO_ENERGY = 97.0  # c: 512 points / 2, times the window's mean square of 0.38
_PAIR_HZ = 45.0  # bandwidth of one independent pair under the window
_PAIRS_OF_ENERGY = 50.0
_NEIGHBOUR = 0.25  # of the scatter is shared by bands, and by frames, side by side
_LEAST_ROOT = 0.2  # of a scattered energy
_TELEPHONE_SHARE, _CODEC_SHARE, _NOISY_SHARE = 0.14, 0.25, 0.6


def _over_bands(values: tuple[float, ...]) -> NDArray[np.float32]:
    """Values at equal mel distances, interpolated to all bands, shape (40,)."""
    at = np.linspace(0, NUM_BANDS - 1, len(values))
    return np.interp(np.arange(NUM_BANDS), at, values).astype(np.float32)


_WIDTH_HZ = np.gradient(BAND_HZ)
_EMPHASIS = 1.9409 - 1.94 * np.cos(2 * np.pi * BAND_HZ / SAMPLE_RATE_HZ)  # |1 - 0.97/z|^2
_FROM_ENERGY = _BANDS_TO_ENERGY * _EMPHASIS * _WIDTH_HZ  # band over energy, of a sound in one band
_PAIRS = np.concatenate([[_PAIRS_OF_ENERGY], np.maximum(1.4, _WIDTH_HZ / _PAIR_HZ)]).astype(
    np.float32
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """One way to change a recording; the same values give the same result."""

    speed: float  # above 1 is faster
    warp: float  # frequencies are multiplied by this
    level: float  # added to all log energies
    noise_below: float  # noise this far below the speech, natural log of power
    noise_tilt: float  # slope of the noise over the bands, natural log; without ``noise_slope``
    colour: tuple[float, ...]  # added to the bands, values at equal mel distances
    decay: float  # share of the energy that stays for the next frame, 0 is a dry room
    narrow: bool  # a telephone line: 300 to 3400 Hz
    seed: int
    lowest_hz: float = 0.0  # what a line, a codec or a poor microphone lets through
    highest_hz: float = SAMPLE_RATE_HZ / 2
    skirt: float = 20.0  # what is outside falls by this in an octave, natural log of power
    stop: float = 8.0  # and by this at most
    noise_slope: float | None = None  # the noise as a sound, power of the frequency: 0 is white
    noise_peaks: tuple[float, ...] = ()  # added to that, like ``colour``
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
        """Draw one at random, up to what a network still learns from: noise at 3 to 30 dB."""
        lowest_hz, highest_hz = 0.0, SAMPLE_RATE_HZ / 2
        line = rng.random()
        if line < _TELEPHONE_SHARE:
            lowest_hz, highest_hz = float(rng.uniform(200, 400)), float(rng.uniform(3000, 4000))
        elif line < _TELEPHONE_SHARE + _CODEC_SHARE:
            lowest_hz = float(rng.uniform(0, 200))
            highest_hz = float(rng.uniform(3800, SAMPLE_RATE_HZ / 2))
        noisy = rng.random() < _NOISY_SHARE
        return cls(
            speed=float(np.exp(rng.uniform(-0.22, 0.22))),
            warp=float(np.exp(rng.uniform(-0.13, 0.13))),
            level=float(rng.uniform(-5.0, 2.0)),
            noise_below=float(rng.uniform(0.7, 7.0) if noisy else rng.uniform(7.0, 13.0)),
            noise_tilt=0.0,
            colour=tuple(rng.normal(0.0, rng.uniform(0.3, 1.2), 6).tolist()),
            decay=float(rng.uniform(0.3, 0.92)) if rng.random() < 0.5 else 0.0,
            narrow=False,
            seed=int(rng.integers(2**31)),
            lowest_hz=lowest_hz,
            highest_hz=highest_hz,
            skirt=float(np.exp(rng.uniform(1.6, 3.7))),
            stop=float(rng.uniform(4.0, 14.0)),
            noise_slope=float(rng.uniform(-2.2, 0.2)),
            noise_peaks=tuple(rng.normal(0.0, rng.uniform(0.2, 1.2), 12).tolist()),
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
        if self.noise_slope is None:
            power += self._noise(power, rng)
        else:
            power = self._in_noise(power, self.noise_slope, rng)
        if self.lowest_hz > LOWEST_HZ or self.highest_hz < HIGHEST_HZ:
            self._send(power)
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

    def _in_noise(
        self, power: NDArray[np.float32], slope: float, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Energies of the recording in a noise that is a sound, shape (frames, 41)."""
        density = (BAND_HZ / 1000.0) ** slope
        if self.noise_peaks:
            density = density * np.exp(_over_bands(self.noise_peaks))
        shares = _FROM_ENERGY * density / np.sum(density * _WIDTH_HZ)
        spectrum = np.concatenate([[1.0], shares]) * np.exp(-self.noise_below) * power[:, 0].mean()
        noise = self._gain(len(power), rng)[:, None] * spectrum.astype(np.float32)
        mean = power + noise
        pairs = mean**2 / (noise * (mean + power)) * _PAIRS
        normal = rng.standard_normal(power.shape, dtype=np.float32)
        normal[:, 2:] += _NEIGHBOUR * normal[:, 1:-1]
        normal[1:] += _NEIGHBOUR * normal[:-1]
        # a gamma variable's cube root is about normal (Wilson and Hilferty 1931)
        normal /= 1 + _NEIGHBOUR**2
        third = 1 / (3 * np.sqrt(pairs))
        root = np.maximum(1 - third**2 + third * normal, _LEAST_ROOT)
        scattered: NDArray[np.float32] = mean * root**3
        return scattered

    def _gain(self, num_frames: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Wanderings of the noise's power, shape (frames,)."""
        gain = np.ones(num_frames)
        if self.flutter:
            knots = rng.normal(0.0, self.flutter, 2 + num_frames // 15)
            gain = np.exp(np.interp(np.arange(num_frames) / 15, np.arange(len(knots)), knots))
        if self.knocks:
            hits = (rng.random(num_frames) < self.knocks) * rng.uniform(1.0, 30.0, num_frames)
            gain = gain + lfilter([1.0], [1.0, -0.4], hits)
        return gain.astype(np.float32)

    def _send(self, power: NDArray[np.float32]) -> None:
        """Take off what does not pass the line, from the log energy too."""
        below = np.log2(np.maximum(1.0, self.lowest_hz / BAND_HZ))
        above = np.log2(np.maximum(1.0, BAND_HZ / self.highest_hz))
        passes = np.exp(-np.minimum(self.stop, self.skirt * (below + above))).astype(np.float32)
        of_sound = (1 / _FROM_ENERGY).astype(np.float32)
        before = power[:, 1:] @ of_sound
        power[:, 1:] *= passes
        power[:, 0] *= power[:, 1:] @ of_sound / before

    def _warped(self, bands: NDArray[np.float32]) -> NDArray[np.float32]:
        source = mel_of(np.minimum(BAND_HZ / self.warp, HIGHEST_HZ))
        at = np.clip(np.interp(source, BAND_MEL, np.arange(NUM_BANDS)), 0, NUM_BANDS - 1)
        low = np.minimum(at.astype(int), NUM_BANDS - 2)
        share = (at - low).astype(np.float32)
        warped: NDArray[np.float32] = (1 - share) * bands[:, low] + share * bands[:, low + 1]
        return warped
