"""Disturbances of speech on its way to a microphone, and sounds without speech.

Everything is drawn with fixed seeds, so that figures can be reproduced.

==================== ===========================================================================
noise at so many dB  pink noise (power falling by 3 dB an octave), relative to the speech's level
babble               six stretches of the recordings at once, likewise
room                 echoes that fall by 60 dB in 0.5 s (noise with an exponential envelope, Polack
                     1988), together as loud as the direct sound
telephone band       300 to 3400 Hz, Butterworth of order 8
MP3, Opus            coded with 16 and 9 kbit/s, and decoded
clipped              at a fifth of the peak
half, double level   samples times 0.5 and 2, clipped at full scale
speech at 0.8x, 1.3x overlap-add of the most similar 20 ms pieces, the pitch stays (Verhelst and
                     Roelands 1993, "WSOLA")
music                chords of plucked strings, four a second, with a bass drum
noise                pink noise whose level wanders
keyboard             strokes of 2 to 6 a second, each two clicks of some milliseconds
breathing            noise between 300 and 3000 Hz, in and out every four seconds
==================== ===========================================================================
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
_REVERBERATION_S = 0.5  # in which a room's echoes fall by 60 dB
_NUM_BABBLING = 6
_MP3 = {"format": "MP3", "subtype": "MPEG_LAYER_III", "bitrate_mode": "CONSTANT"}
_OPUS = {"format": "OGG", "subtype": "OPUS"}


def pink_noise(num_samples: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise of equal power in every octave, of root mean square 1."""
    spectrum = np.fft.rfft(rng.normal(size=num_samples))
    frequency = np.maximum(np.fft.rfftfreq(num_samples), 20 / SAMPLE_RATE_HZ)
    noise = np.fft.irfft(spectrum / np.sqrt(frequency), num_samples)
    return np.asarray(noise / np.sqrt(np.mean(noise**2)))


def with_noise(samples: Samples, below_db: float) -> Samples:
    """Add pink noise ``below_db`` decibels below the speech's level."""
    noise = pink_noise(len(samples), np.random.default_rng(len(samples)))
    return _mixed(samples, noise, below_db)


def babble(voices: Sequence[Samples]) -> Samples:
    """Lay six stretches of the recordings on each other, each recording equally loud."""
    speech = np.concatenate([voice / max(1e-9, np.sqrt(np.mean(voice**2))) for voice in voices])
    starts = np.arange(_NUM_BABBLING) * len(speech) // _NUM_BABBLING
    together: Samples = np.sum([np.roll(speech, start) for start in starts], axis=0)
    return together


def with_sound(samples: Samples, sound: Samples, below_db: float) -> Samples:
    """Add a stretch of a sound, repeated if need be, ``below_db`` below the speech's level."""
    start = np.random.default_rng(len(samples)).integers(len(sound))
    return _mixed(samples, np.resize(np.roll(sound, -start), len(samples)), below_db)


def in_a_room(samples: Samples) -> Samples:
    """Add echoes that are together as loud as the direct sound."""
    num_samples = round(_REVERBERATION_S * SAMPLE_RATE_HZ)
    decay = 10 ** (-3 * np.arange(num_samples) / num_samples)  # by 60 dB
    echoes = np.random.default_rng(5).normal(size=num_samples) * decay
    heard = fftconvolve(samples, echoes / np.sqrt(np.sum(echoes**2)))[: len(samples)]
    return _clipped((samples + heard) / np.sqrt(2))


def coded(samples: Samples, codec: dict[str, str], compression_level: float) -> Samples:
    """Code speech and decode it; libsndfile turns its level, 0 to 1, into a bit rate."""
    file = BytesIO()
    soundfile.write(file, samples, SAMPLE_RATE_HZ, compression_level=compression_level, **codec)
    file.seek(0)
    decoded, _ = soundfile.read(file, dtype="float32")
    return _clipped(decoded)


def telephone(samples: Samples) -> Samples:
    """Keep 300 to 3400 Hz."""
    band = butter(8, [300, 3400], "bandpass", fs=SAMPLE_RATE_HZ, output="sos")
    return _clipped(sosfilt(band, samples))


def clipped_at(samples: Samples, fraction: float) -> Samples:
    """Clip the samples at a fraction of their peak."""
    limit = fraction * np.abs(samples).max()
    clipped: Samples = np.clip(samples, -limit, limit)
    return clipped


def louder(samples: Samples, factor: float) -> Samples:
    """Multiply the samples and clip them at full scale."""
    return _clipped(samples * factor)


def faster(samples: Samples, factor: float) -> Samples:
    """Change the speed of speech and keep its pitch."""
    hop, search = 160, 120  # 10 and 7.5 ms; pieces are two hops long
    window = np.hanning(2 * hop + 1)[: 2 * hop]
    padded = np.pad(samples.astype(np.float64), (search, 3 * hop + 2 * search))
    num_pieces = int(len(samples) / (hop * factor))
    out = np.zeros((num_pieces + 1) * hop)
    taken = 0  # where the last piece was taken from
    for number in range(num_pieces):
        at = round(number * hop * factor)
        if number:
            wanted = padded[taken + hop : taken + 3 * hop]  # the continuation without a cut
            near = padded[at : at + 2 * search + 2 * hop]
            energy = np.convolve(near**2, np.ones(2 * hop), "valid")
            similarity = np.correlate(near, wanted, "valid") / np.sqrt(energy + 1e-9)
            at += int(similarity.argmax())
        taken = at
        out[number * hop : (number + 2) * hop] += window * padded[at : at + 2 * hop]
    return _clipped(out[hop:])


SPEECH_CONDITIONS: dict[str, Callable[[Samples], Samples]] = {
    "as recorded": lambda samples: samples,
    "noise 20 dB below": lambda samples: with_noise(samples, 20),
    "noise 10 dB below": lambda samples: with_noise(samples, 10),
    "noise 5 dB below": lambda samples: with_noise(samples, 5),
    "room": in_a_room,
    "telephone band": telephone,
    "MP3, 16 kbit/s": lambda samples: coded(samples, _MP3, 0.95),
    "Opus, 9 kbit/s": lambda samples: coded(samples, _OPUS, 0.99),
    "clipped at a fifth": lambda samples: clipped_at(samples, 0.2),
    "half level": lambda samples: louder(samples, 0.5),
    "double level": lambda samples: louder(samples, 2.0),
    "0.8 times the speed": lambda samples: faster(samples, 0.8),
    "1.3 times the speed": lambda samples: faster(samples, 1.3),
}


def music(seconds: float) -> Samples:
    """Chords of plucked strings over a drum."""
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
    return _at_level(out[: round(seconds * SAMPLE_RATE_HZ)])


def wandering_noise(seconds: float) -> Samples:
    """Pink noise whose level wanders by some decibels."""
    rng = np.random.default_rng(2)
    noise = pink_noise(round(seconds * SAMPLE_RATE_HZ), rng)
    knots = rng.normal(0, 0.5, max(2, round(seconds)))
    gain = np.exp(np.interp(np.linspace(0, 1, len(noise)), np.linspace(0, 1, len(knots)), knots))
    return _at_level(gain * noise)


def keyboard(seconds: float) -> Samples:
    """Strokes on a keyboard: a click down and a weaker one up."""
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
    return _at_level(out[: round(seconds * SAMPLE_RATE_HZ)])


def breathing(seconds: float) -> Samples:
    """Breathing in and out near the microphone."""
    rng = np.random.default_rng(4)
    num_samples = round(seconds * SAMPLE_RATE_HZ)
    band = butter(2, [300, 3000], "bandpass", fs=SAMPLE_RATE_HZ, output="sos")
    noise = sosfiltfilt(band, rng.normal(size=num_samples))
    phase = 2 * np.pi * np.arange(num_samples) / (4 * SAMPLE_RATE_HZ)
    strength = np.maximum(0, np.sin(phase)) + 0.6 * np.maximum(0, -np.sin(phase)) ** 2
    return _at_level(noise * strength)


SOUNDS: dict[str, Callable[[float], Samples]] = {
    "music": music,
    "noise": wandering_noise,
    "keyboard": keyboard,
    "breathing": breathing,
}


def _mixed(samples: Samples, sound: NDArray[np.floating], below_db: float) -> Samples:
    gain = np.sqrt(np.mean(samples.astype(np.float64) ** 2) / np.mean(sound**2))
    return _clipped(samples + gain * 10 ** (-below_db / 20) * sound)


def _at_level(sound: NDArray[np.float64]) -> Samples:
    """Scale to -26 dB of full scale, the level of speech near a microphone."""
    return _clipped(sound / np.sqrt(np.mean(sound**2)) * 0.05)


def _clipped(sound: NDArray[np.floating]) -> Samples:
    clipped: Samples = np.clip(sound, -1.0, 1.0).astype(np.float32)
    return clipped
