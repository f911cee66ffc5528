"""Augmentation of samples: speeds, rooms, noises and lines.

Sources: Ko et al. 2015, "Audio augmentation for speech recognition" (speed by resampling, which
also moves pitch and formants); Ko et al. 2017, "A study on data augmentation of reverberant speech
for robust speech recognition" (rooms and noise); Polack 1988 (a room's response is a decaying
noise).

======== ============================================================= ============
symbol   meaning                                                       unit, shape
======== ============================================================= ============
x        samples at 16 kHz                                             (n,)
s        speed; above 1 is faster                                      1
T60      time in which reverberation falls by 60 dB                    s
h        a room's response: h[0] = 1, then noise * exp(-6.9 t / T60)   (m,)
f^b      power density of the noise, multiplied by random peaks        1
t        number of a feature frame, samples 160 t to 160 t + 400       1
======== ============================================================= ============

The given generator draws everything, so the same state gives the same result. Each augmented frame
takes the targets of its source frame in the recording. The middle of frame t, sample 160 t + 200,
was sample s (160 t + 200) of the recording, which is the middle of the source frame

    t_source = s t + (s - 1) 200 / 160
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import butter, fftconvolve, resample_poly, sosfilt

from kouxing.services.recognizer.front_end.features import HOP_S, SAMPLE_RATE_HZ, WINDOW_S
from kouxing.shared.arrays import Doubles, Floats, Int16, Integers
from kouxing.shared.audio.pcm import as_floats

Samples = Floats
Sound = NDArray[np.floating[Any]]  # samples during processing

_HALF_RATE_HZ = SAMPLE_RATE_HZ / 2
_HALF_WINDOW = WINDOW_S / HOP_S / 2  # from a frame's first sample to its middle, frames
_TINY = 1e-9

# Probabilities of the changes.
_SPEED_PROB, _ROOM_PROB, _NOISE_PROB, _COLOR_PROB = 0.75, 0.35, 0.6, 0.5
_TELEPHONE_PROB, _CODEC_PROB = 0.14, 0.2
_FLUTTER_PROB, _KNOCKS_PROB = 0.35, 0.15  # probabilities of a change to a noise

_SPEED_STEPS, _MIN_STEPS, _MAX_STEPS = 20, 17, 24  # new lengths are 17/20 to 24/20
_MIN_T60_S, _MAX_T60_S, _MAX_ROOM_S = 0.1, 0.7, 0.5
_MIN_SNR_DB, _MAX_SNR_DB = 3.0, 30.0
_MIN_NOISE_HZ = 50.0  # the noise's spectrum is flat below
_FLUTTER_SAMPLES = 2400  # between two knots of the noise's level
_KNOCK_SAMPLES = 160
_KNOCK_RATE = 0.03  # fraction of the pieces of this length with a knock
_MIN_PEAK_DB = -36.0  # relative to full scale


def augment_samples(samples: Samples, rng: np.random.Generator) -> tuple[Samples, float]:
    """Augment samples, (n,) at 16 kHz, at random.

    Return the new samples, (n / speed,), and the speed.
    """
    sound, speed = change_speed(samples, rng)
    return disturb(sound, rng), speed


def change_speed(samples: Sound, rng: np.random.Generator) -> tuple[Sound, float]:
    """Change the speed at random; return the new samples, (n / speed,), and the speed."""
    if rng.random() < _SPEED_PROB:
        steps = int(rng.integers(_MIN_STEPS, _MAX_STEPS + 1))
        return resample_poly(samples, steps, _SPEED_STEPS), _SPEED_STEPS / steps
    return samples, 1.0


def disturb(samples: Sound, rng: np.random.Generator) -> Samples:
    """Simulate a room, noise, a transmission line and a microphone, each at random."""
    sound = samples
    if rng.random() < _ROOM_PROB:
        sound = fftconvolve(sound, _room_response(rng))[: len(sound)]
    if rng.random() < _NOISE_PROB:
        sound = sound + _colored_noise(sound, rng)
    sound = _transmit(sound, rng)
    if rng.random() < _COLOR_PROB:
        sound = _filter_response(sound, rng)
    return sound.astype(np.float32)


def add_sounds(
    samples: Sound, others: Sequence[Int16], snr_db: float, rng: np.random.Generator
) -> Sound:
    """Add other sounds of equal levels, together ``snr_db`` below the samples.

    They start anywhere, and are repeated if they are too short.
    """
    background = np.zeros(len(samples))
    for other in others:
        turned = np.roll(other, -int(rng.integers(len(other))))
        repeated = as_floats(np.resize(turned, len(samples)))
        background += repeated / (np.sqrt(np.mean(repeated**2)) + _TINY)
    level = np.sqrt(np.mean(np.square(samples)) / (np.mean(background**2) + _TINY))
    return np.asarray(samples + level * 10 ** (-snr_db / 20) * background)


def scale_level(samples: Samples, rng: np.random.Generator) -> Samples:
    """Scale the peak to a random level, -36 to 0 dB of full scale."""
    peak = np.abs(samples).max() + _TINY
    gain = 10 ** (rng.uniform(_MIN_PEAK_DB, 0.0) / 20) / peak
    return samples * np.float32(gain)


def source_frames(num_frames: int, speed: float, num_source: int) -> Integers:
    """Return the source frame of each frame after a change of speed, (num_frames,)."""
    source = speed * np.arange(num_frames) + (speed - 1) * _HALF_WINDOW  # t_source
    return np.asarray(np.clip(np.rint(source), 0, num_source - 1).astype(np.int64))


def _room_response(rng: np.random.Generator) -> Doubles:
    """Draw a room's response; the first echo arrives after 1 to 8 ms."""
    t60_s = rng.uniform(_MIN_T60_S, _MAX_T60_S)
    num_samples = int(SAMPLE_RATE_HZ * min(t60_s, _MAX_ROOM_S))
    time_s = np.arange(num_samples) / SAMPLE_RATE_HZ
    response: Doubles = rng.standard_normal(num_samples)
    response *= np.exp(-6.9 * time_s / t60_s)
    response[: int(SAMPLE_RATE_HZ * rng.uniform(0.001, 0.008))] = 0.0
    response *= rng.uniform(0.1, 0.8) / np.sqrt((response**2).sum() + _TINY)
    response[0] = 1.0
    return response


def _colored_noise(samples: Sound, rng: np.random.Generator) -> Doubles:
    """Draw a noise 3 to 30 dB below a recording."""
    num_samples = len(samples)
    size = next_fast_len(num_samples, real=True)
    frequency = np.maximum(np.fft.rfftfreq(size, 1 / SAMPLE_RATE_HZ), _MIN_NOISE_HZ)
    slope = rng.uniform(-2.2, 0.2)
    density = (frequency / 1000) ** (slope / 2) * _random_curve(frequency, 12, (0.1, 0.7), rng)
    noise = irfft(rfft(rng.standard_normal(size)) * density, size)[:num_samples]
    if rng.random() < _FLUTTER_PROB:
        num_knots = 2 + num_samples // _FLUTTER_SAMPLES
        knots = rng.normal(0.0, rng.uniform(0.2, 0.8), num_knots)
        position = np.arange(num_samples) / _FLUTTER_SAMPLES
        noise *= np.exp(np.interp(position, np.arange(num_knots), knots))
    if rng.random() < _KNOCKS_PROB:
        num_pieces = num_samples // _KNOCK_SAMPLES + 1
        knocks = (rng.random(num_pieces) < _KNOCK_RATE) * rng.uniform(1.0, 6.0, num_pieces)
        noise *= 1 + np.repeat(knocks, _KNOCK_SAMPLES)[:num_samples]
    below_db = rng.uniform(_MIN_SNR_DB, _MAX_SNR_DB)
    return np.asarray(
        noise
        * (
            np.sqrt(np.mean(np.square(samples)) / (np.mean(noise**2) + _TINY))
            * 10 ** (-below_db / 20)
        )
    )


def _transmit(samples: Sound, rng: np.random.Generator) -> Sound:
    line = rng.random()
    if line < _TELEPHONE_PROB:
        band = [rng.uniform(200, 400), rng.uniform(3000, 3900)]
        filters = butter(int(rng.integers(2, 5)), band, "band", fs=SAMPLE_RATE_HZ, output="sos")
    elif line < _TELEPHONE_PROB + _CODEC_PROB:
        order, highest_hz = int(rng.integers(2, 7)), rng.uniform(3800, 7800)
        filters = butter(order, highest_hz, "low", fs=SAMPLE_RATE_HZ, output="sos")
    else:
        return samples
    return np.asarray(sosfilt(filters, samples))


def _filter_response(samples: Sound, rng: np.random.Generator) -> Doubles:
    size = next_fast_len(len(samples), real=True)
    color = _random_curve(np.fft.rfftfreq(size, 1 / SAMPLE_RATE_HZ), 7, (0.1, 0.5), rng)
    return np.asarray(irfft(rfft(samples, size) * color, size)[: len(samples)])


def _random_curve(
    frequency: NDArray[np.floating[Any]],
    num_knots: int,
    spread: tuple[float, float],
    rng: np.random.Generator,
) -> Doubles:
    """Draw amplitudes over frequency; the spread of their logarithm is also drawn."""
    knots = rng.normal(0.0, rng.uniform(*spread), num_knots)
    frequency_hz = np.linspace(0.0, _HALF_RATE_HZ, num_knots)
    return np.asarray(np.exp(np.interp(frequency, frequency_hz, knots)))
