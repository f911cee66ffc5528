"""Another speed, room, noise and line for the same recording, made on its samples.

Sources: Ko et al. 2015, "Audio augmentation for speech recognition" (speed, by resampling: pitch
and formants move along); Ko et al. 2017, "A study on data augmentation of reverberant speech for
robust speech recognition" (rooms and noise); Polack 1988 (a room's response is a decaying noise);
Park et al. 2019, "SpecAugment" (masks of frames and bands).

======== ============================================================= ============
symbol   meaning                                                       unit, shape
======== ============================================================= ============
x        samples at 16 kHz                                             (n,)
s        speed; above 1 is faster                                      1
T60      a room's sound falls by 60 dB in it                           s
h        a room's response: h[0] = 1, then noise * exp(-6.9 t / T60)   (m,)
f^b      power density of the noise, multiplied by random peaks        1
t        number of a feature frame, samples 160 t to 160 t + 400       1
======== ============================================================= ============

Everything is drawn from the generator that is given: the same state gives the same sound. Changed
frames know which frames of the recording they were. A frame's middle, sample 160 t + 200, lay at
sample s (160 t + 200) of the recording, which is the middle of its frame

    t_before = s t + (s - 1) 200 / 160

A tempo changes the frames' number and leaves the pitch alone: frames are interpolated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, fftconvolve, resample_poly, sosfilt

from services.recognizer.features import HOP_S, SAMPLE_RATE_HZ, WINDOW_S

Samples = NDArray[np.float32]
Sound = NDArray[np.floating[Any]]  # samples while they are worked on

_HALF_RATE_HZ = SAMPLE_RATE_HZ / 2
_MIDDLE_FRAMES = WINDOW_S / HOP_S / 2  # of a frame, from its first sample
_TINY = 1e-9

_SPEED_SHARE = 0.75
_SPEED_STEPS, _LEAST_STEPS, _MOST_STEPS = 20, 17, 24  # new lengths are 17/20 to 24/20
_ROOM_SHARE = 0.35
_SHORTEST_T60_S, _LONGEST_T60_S, _LONGEST_ROOM_S = 0.1, 0.7, 0.5
_NOISE_SHARE = 0.6
_LEAST_SNR_DB, _MOST_SNR_DB = 3.0, 30.0
_SLOWEST_HZ = 50.0  # noise is no stronger below
_FLUTTER_SHARE, _KNOCKS_SHARE = 0.35, 0.15
_FLUTTER_SAMPLES = 2400  # from one knot of the noise's level to the next
_KNOCK_SAMPLES = 160
_KNOCKING = 0.03  # of these pieces
_TELEPHONE_SHARE, _CODEC_SHARE = 0.14, 0.2
_COLOUR_SHARE = 0.5
_QUIETEST_DB = -36.0  # the peak, against full scale
_SLOWEST, _FASTEST = -0.20, 0.25  # log of the tempo
_MOST_MASKS, _MOST_MASKED_FRAMES, _MOST_MASKED_BANDS = 2, 12, 14


def changed_sound(samples: Samples, rng: np.random.Generator) -> tuple[Samples, float]:
    """Change a recording at random.

    Parameters
    ----------
    samples
        Shape (n,), 16 kHz.
    rng
        Decides everything.

    Returns
    -------
    tuple
        The new samples, shape (n / speed,), and the speed.
    """
    sound: Sound = samples
    speed = 1.0
    if rng.random() < _SPEED_SHARE:
        steps = int(rng.integers(_LEAST_STEPS, _MOST_STEPS + 1))
        sound, speed = resample_poly(sound, steps, _SPEED_STEPS), _SPEED_STEPS / steps
    if rng.random() < _ROOM_SHARE:
        sound = fftconvolve(sound, _room(rng))[: len(sound)]
    if rng.random() < _NOISE_SHARE:
        sound = sound + _noise(sound, rng)
    sound = _sent(sound, rng)
    if rng.random() < _COLOUR_SHARE:
        sound = _coloured(sound, rng)
    return sound.astype(np.float32), speed


def levelled(samples: Samples, rng: np.random.Generator) -> Samples:
    """Put the peak at a random level, -36 to 0 dB of full scale."""
    peak = np.abs(samples).max() + _TINY
    gain = 10 ** (rng.uniform(_QUIETEST_DB, 0.0) / 20) / peak
    return samples * np.float32(gain)


def frames_before(num_frames: int, speed: float, num_before: int) -> NDArray[np.int64]:
    """Which of a recording's frames each frame was before its speed changed, (num_frames,)."""
    at = speed * np.arange(num_frames) + (speed - 1) * _MIDDLE_FRAMES  # the docstring's t_before
    nearest: NDArray[np.int64] = np.clip(np.rint(at), 0, num_before - 1).astype(np.int64)
    return nearest


def changed_tempo(
    frames: NDArray[np.float32], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Stretch or shorten the time; return new frames, (m, k), and which frames they were, (m,)."""
    num_frames = round(len(frames) / np.exp(rng.uniform(_SLOWEST, _FASTEST)))
    at = np.linspace(0, len(frames) - 1, max(1, num_frames))
    low = np.minimum(at.astype(np.int64), len(frames) - 2)
    share = (at - low)[:, None].astype(np.float32)
    return (1 - share) * frames[low] + share * frames[low + 1], np.rint(at).astype(np.int64)


def mask(frames: NDArray[np.float32], rng: np.random.Generator) -> None:
    """Put the mean in the place of some frames and some bands of all frames."""
    mean = frames.mean()
    for _ in range(rng.integers(_MOST_MASKS + 1)):
        at, width = rng.integers(len(frames)), rng.integers(1, _MOST_MASKED_FRAMES + 1)
        frames[at : at + width] = mean
    for _ in range(rng.integers(_MOST_MASKS + 1)):
        at, width = rng.integers(frames.shape[1]), rng.integers(1, _MOST_MASKED_BANDS + 1)
        frames[:, at : at + width] = mean


def _room(rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a room's response, of which the first echo comes after 1 to 8 ms."""
    t60_s = rng.uniform(_SHORTEST_T60_S, _LONGEST_T60_S)
    num_samples = int(SAMPLE_RATE_HZ * min(t60_s, _LONGEST_ROOM_S))
    time_s = np.arange(num_samples) / SAMPLE_RATE_HZ
    response: NDArray[np.float64] = rng.standard_normal(num_samples)
    response *= np.exp(-6.9 * time_s / t60_s)
    response[: int(SAMPLE_RATE_HZ * rng.uniform(0.001, 0.008))] = 0.0
    response *= rng.uniform(0.1, 0.8) / np.sqrt((response**2).sum() + _TINY)
    response[0] = 1.0
    return response


def _noise(samples: Sound, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a noise for a recording, 3 to 30 dB below it."""
    num_samples = len(samples)
    frequency = np.maximum(np.fft.rfftfreq(num_samples, 1 / SAMPLE_RATE_HZ), _SLOWEST_HZ)
    slope = rng.uniform(-2.2, 0.2)
    density = (frequency / 1000) ** (slope / 2) * _wandering(frequency, 12, (0.1, 0.7), rng)
    noise = np.fft.irfft(np.fft.rfft(rng.standard_normal(num_samples)) * density, num_samples)
    if rng.random() < _FLUTTER_SHARE:
        num_knots = 2 + num_samples // _FLUTTER_SAMPLES
        knots = rng.normal(0.0, rng.uniform(0.2, 0.8), num_knots)
        at = np.arange(num_samples) / _FLUTTER_SAMPLES
        noise *= np.exp(np.interp(at, np.arange(num_knots), knots))
    if rng.random() < _KNOCKS_SHARE:
        num_pieces = num_samples // _KNOCK_SAMPLES + 1
        knocks = (rng.random(num_pieces) < _KNOCKING) * rng.uniform(1.0, 6.0, num_pieces)
        noise *= 1 + np.repeat(knocks, _KNOCK_SAMPLES)[:num_samples]
    below_db = rng.uniform(_LEAST_SNR_DB, _MOST_SNR_DB)
    scaled: NDArray[np.float64] = noise * (
        np.sqrt(np.mean(np.square(samples)) / (np.mean(noise**2) + _TINY)) * 10 ** (-below_db / 20)
    )
    return scaled


def _sent(samples: Sound, rng: np.random.Generator) -> Sound:
    """Send some of the recordings over a telephone or through a codec."""
    line = rng.random()
    if line < _TELEPHONE_SHARE:
        band = [rng.uniform(200, 400), rng.uniform(3000, 3900)]
        filters = butter(int(rng.integers(2, 5)), band, "band", fs=SAMPLE_RATE_HZ, output="sos")
    elif line < _TELEPHONE_SHARE + _CODEC_SHARE:
        order, highest_hz = int(rng.integers(2, 7)), rng.uniform(3800, 7800)
        filters = butter(order, highest_hz, "low", fs=SAMPLE_RATE_HZ, output="sos")
    else:
        return samples
    sent: Sound = sosfilt(filters, samples)
    return sent


def _coloured(samples: Sound, rng: np.random.Generator) -> NDArray[np.float64]:
    """Hear a recording with another microphone."""
    frequency = np.fft.rfftfreq(len(samples), 1 / SAMPLE_RATE_HZ)
    colour = _wandering(frequency, 7, (0.1, 0.5), rng)
    return np.fft.irfft(np.fft.rfft(samples) * colour, len(samples))


def _wandering(
    frequency: NDArray[np.floating[Any]],
    num_knots: int,
    spread: tuple[float, float],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw an amplitude over frequency whose logarithm wanders by a spread, itself drawn."""
    knots = rng.normal(0.0, rng.uniform(*spread), num_knots)
    at = np.linspace(0.0, _HALF_RATE_HZ, num_knots)
    curve: NDArray[np.float64] = np.exp(np.interp(frequency, at, knots))
    return curve
