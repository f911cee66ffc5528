"""Disturbances of speech on its way to a microphone, and sounds without speech.

All random numbers have fixed seeds, so that figures can be reproduced.

====================  ==========================================================================
noise N dB below      pink noise (power falling by 3 dB per octave), relative to the speech level
babble                six parts of the recordings at once, likewise
room                  echoes that fall by 60 dB in 0.5 s (noise with an exponential envelope, Polack
                      1988), together as loud as the direct sound
limit_to_telephone_band band        300 to 3400 Hz, Butterworth of order 8
MP3, Opus             encoded with 16 and 9 kbit/s, and decoded
clipped               at a fifth of the peak
half, double level    samples times 0.5 and 2, clipped at full scale
0.8, 1.3 times the    overlap-add of the most similar 20 ms segments at constant pitch (WSOLA,
speed                 Verhelst and Roelands 1993)
music                 chords of plucked strings, four per second, with a bass drum
noise                 pink noise with a varying level
keyboard              2 to 6 strokes per second, each with two clicks of some milliseconds
breathing             noise between 300 and 3000 Hz, in and out every four seconds
====================  ==========================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from io import BytesIO

import numpy as np
import soundfile
from numpy.typing import NDArray
from scipy.signal import butter, fftconvolve, sosfilt, sosfiltfilt

from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ

Samples = NDArray[np.float32]  # (n,), 16 kHz, in [-1, 1]
_TWELFTH = 2 ** (1 / 12)
_REVERBERATION_S = 0.5  # time in which echoes fall by 60 dB
_NUM_VOICES = 6
_MP3 = {"format": "MP3", "subtype": "MPEG_LAYER_III", "bitrate_mode": "CONSTANT"}
_OPUS = {"format": "OGG", "subtype": "OPUS"}


def pink_noise(num_samples: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return noise with equal power in every octave and an RMS of 1."""
    spectrum = np.fft.rfft(rng.normal(size=num_samples))
    frequency = np.maximum(np.fft.rfftfreq(num_samples), 20 / SAMPLE_RATE_HZ)
    noise = np.fft.irfft(spectrum / np.sqrt(frequency), num_samples)
    return np.asarray(noise / np.sqrt(np.mean(noise**2)))


def add_noise(samples: Samples, below_db: float) -> Samples:
    """Add pink noise ``below_db`` decibels below the speech's level."""
    noise = pink_noise(len(samples), np.random.default_rng(len(samples)))
    return _mix(samples, noise, below_db)


def babble(voices: Sequence[Samples]) -> Samples:
    """Mix six parts of the recordings. Each recording has the same level."""
    speech = np.concatenate([voice / max(1e-9, np.sqrt(np.mean(voice**2))) for voice in voices])
    starts = np.arange(_NUM_VOICES) * len(speech) // _NUM_VOICES
    together: Samples = np.sum([np.roll(speech, start) for start in starts], axis=0)
    return together


def add_sound(samples: Samples, sound: Samples, below_db: float) -> Samples:
    """Add a part of a sound, repeated if necessary, ``below_db`` below the speech's level."""
    start = np.random.default_rng(len(samples)).integers(len(sound))
    return _mix(samples, np.resize(np.roll(sound, -start), len(samples)), below_db)


def add_echoes(samples: Samples) -> Samples:
    """Add echoes that are together as loud as the direct sound."""
    num_samples = round(_REVERBERATION_S * SAMPLE_RATE_HZ)
    decay = 10 ** (-3 * np.arange(num_samples) / num_samples)  # by 60 dB
    echoes = np.random.default_rng(5).normal(size=num_samples) * decay
    heard = fftconvolve(samples, echoes / np.sqrt(np.sum(echoes**2)))[: len(samples)]
    return _clip_to_full_scale((samples + heard) / np.sqrt(2))


def encode_and_decode(samples: Samples, codec: dict[str, str], compression_level: float) -> Samples:
    """Encode and decode speech. libsndfile derives the bit rate from the level, 0 to 1."""
    file = BytesIO()
    soundfile.write(file, samples, SAMPLE_RATE_HZ, compression_level=compression_level, **codec)
    file.seek(0)
    decoded, _ = soundfile.read(file, dtype="float32")
    return _clip_to_full_scale(decoded)


def limit_to_telephone_band(samples: Samples) -> Samples:
    """Keep only 300 to 3400 Hz."""
    band = butter(8, [300, 3400], "bandpass", fs=SAMPLE_RATE_HZ, output="sos")
    return _clip_to_full_scale(sosfilt(band, samples))


def clip(samples: Samples, fraction: float) -> Samples:
    """Clip the samples at a fraction of their peak."""
    limit = fraction * np.abs(samples).max()
    clipped: Samples = np.clip(samples, -limit, limit)
    return clipped


def change_level(samples: Samples, factor: float) -> Samples:
    """Multiply the samples and clip them at full scale."""
    return _clip_to_full_scale(samples * factor)


def change_speed(samples: Samples, factor: float) -> Samples:
    """Change the speed of speech at constant pitch."""
    hop, search = 160, 120  # 10 and 7.5 ms; segments are two hops long
    window = np.hanning(2 * hop + 1)[: 2 * hop]
    padded = np.pad(samples.astype(np.float64), (search, 3 * hop + 2 * search))
    num_segments = int(len(samples) / (hop * factor))
    out = np.zeros((num_segments + 1) * hop)
    source = 0  # start of the last segment
    for number in range(num_segments):
        at = round(number * hop * factor)
        if number:
            continuation = padded[source + hop : source + 3 * hop]  # the natural continuation
            near = padded[at : at + 2 * search + 2 * hop]
            energy = np.convolve(near**2, np.ones(2 * hop), "valid")
            similarity = np.correlate(near, continuation, "valid") / np.sqrt(energy + 1e-9)
            at += int(similarity.argmax())
        source = at
        out[number * hop : (number + 2) * hop] += window * padded[at : at + 2 * hop]
    return _clip_to_full_scale(out[hop:])


SPEECH_CONDITIONS: dict[str, Callable[[Samples], Samples]] = {
    "as recorded": lambda samples: samples,
    "noise 20 dB below": lambda samples: add_noise(samples, 20),
    "noise 10 dB below": lambda samples: add_noise(samples, 10),
    "noise 5 dB below": lambda samples: add_noise(samples, 5),
    "room": add_echoes,
    "telephone band": limit_to_telephone_band,
    "MP3, 16 kbit/s": lambda samples: encode_and_decode(samples, _MP3, 0.95),
    "Opus, 9 kbit/s": lambda samples: encode_and_decode(samples, _OPUS, 0.99),
    "clipped at a fifth": lambda samples: clip(samples, 0.2),
    "half level": lambda samples: change_level(samples, 0.5),
    "double level": lambda samples: change_level(samples, 2.0),
    "0.8 times the speed": lambda samples: change_speed(samples, 0.8),
    "1.3 times the speed": lambda samples: change_speed(samples, 1.3),
}


def music(seconds: float) -> Samples:
    """Return chords of plucked strings with a drum."""
    rng = np.random.default_rng(1)
    out = np.zeros(round((seconds + 2) * SAMPLE_RATE_HZ))
    time_s = np.arange(SAMPLE_RATE_HZ) / SAMPLE_RATE_HZ
    for beat in range(round(4 * seconds)):
        start = beat * SAMPLE_RATE_HZ // 4
        root = 110 * _TWELFTH ** int(rng.choice([0, 3, 5, 7, 8, 10]))
        for interval in rng.choice([0, 3, 4, 7, 12, 16, 19], 3, replace=False):
            pitch_hz = root * _TWELFTH ** int(interval)
            for harmonic in range(1, 9):
                tone = np.sin(2 * np.pi * harmonic * pitch_hz * time_s)
                out[start : start + len(time_s)] += (
                    tone * np.exp(-(3 + harmonic) * time_s) / harmonic
                )
        if beat % 2 == 0:
            drum = np.sin(2 * np.pi * 60 * time_s) * np.exp(-20 * time_s)
            out[start : start + len(time_s)] += 3 * drum
    return _normalize(out[: round(seconds * SAMPLE_RATE_HZ)])


def varying_noise(seconds: float) -> Samples:
    """Return pink noise whose level varies by some decibels."""
    rng = np.random.default_rng(2)
    noise = pink_noise(round(seconds * SAMPLE_RATE_HZ), rng)
    knots = rng.normal(0, 0.5, max(2, round(seconds)))
    gain = np.exp(np.interp(np.linspace(0, 1, len(noise)), np.linspace(0, 1, len(knots)), knots))
    return _normalize(gain * noise)


def keyboard(seconds: float) -> Samples:
    """Return strokes on a keyboard: a click down and a weaker one up."""
    rng = np.random.default_rng(3)
    out = np.zeros(round((seconds + 1) * SAMPLE_RATE_HZ))
    at_s = 0.2
    while at_s < seconds:
        for offset_s, gain in ((0.0, 1.0), (float(rng.uniform(0.06, 0.1)), 0.5)):
            length = int(rng.integers(40, 160))
            click = gain * rng.normal(size=length) * np.exp(-np.arange(length) / 30)
            start = round((at_s + offset_s) * SAMPLE_RATE_HZ)
            out[start : start + length] += click
        at_s += float(rng.uniform(0.15, 0.5))
    return _normalize(out[: round(seconds * SAMPLE_RATE_HZ)])


def breathing(seconds: float) -> Samples:
    """Return breathing in and out near the microphone."""
    rng = np.random.default_rng(4)
    num_samples = round(seconds * SAMPLE_RATE_HZ)
    band = butter(2, [300, 3000], "bandpass", fs=SAMPLE_RATE_HZ, output="sos")
    noise = sosfiltfilt(band, rng.normal(size=num_samples))
    phase = 2 * np.pi * np.arange(num_samples) / (4 * SAMPLE_RATE_HZ)
    strength = np.maximum(0, np.sin(phase)) + 0.6 * np.maximum(0, -np.sin(phase)) ** 2
    return _normalize(noise * strength)


SOUNDS: dict[str, Callable[[float], Samples]] = {
    "music": music,
    "noise": varying_noise,
    "keyboard": keyboard,
    "breathing": breathing,
}


def _mix(samples: Samples, sound: NDArray[np.floating], below_db: float) -> Samples:
    gain = np.sqrt(np.mean(samples.astype(np.float64) ** 2) / np.mean(sound**2))
    return _clip_to_full_scale(samples + gain * 10 ** (-below_db / 20) * sound)


def _normalize(sound: NDArray[np.float64]) -> Samples:
    """Scale to -26 dB full scale, the level of speech near a microphone."""
    return _clip_to_full_scale(sound / np.sqrt(np.mean(sound**2)) * 0.05)


def _clip_to_full_scale(sound: NDArray[np.floating]) -> Samples:
    clipped: Samples = np.clip(sound, -1.0, 1.0).astype(np.float32)
    return clipped
