"""Synthesized sounds: music, noises, and voices that hold a vowel or sing.

All random numbers have fixed seeds, so that figures can be reproduced.

================  ==============================================================================
music             chords of plucked strings, four per second, with a bass drum
noise             pink noise (power falling by 3 dB per octave) with a varying level
keyboard          2 to 6 strokes per second, each with two clicks of some milliseconds
breathing         noise between 300 and 3000 Hz, in and out every four seconds
held vowels       a, o, e, i, u, ü for 3 s each, by a low and a high voice
melody            the same vowels on notes of 0.3 to 1.2 s, with vibrato
================  ==============================================================================

A vowel is a train of glottal pulses through four formants in cascade (Klatt 1980).
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter, sosfiltfilt

from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.shared.arrays import Doubles, Floats

Samples = Floats  # (n,), 16 kHz, in [-1, 1]
_TWELFTH = 2 ** (1 / 12)

_FORMANTS_HZ = {  # formants of a male voice
    "a": (850, 1250, 2600, 3500),
    "o": (550, 850, 2500, 3400),
    "e": (500, 1150, 2450, 3400),
    "i": (290, 2250, 2950, 3600),
    "u": (330, 650, 2300, 3300),
    "ü": (290, 1950, 2300, 3300),
}
_BANDWIDTHS_HZ = (70, 100, 150, 250)
_VOICES = ((120.0, 1.0), (220.0, 1.15))  # pitch in Hz, factor of the formants
_HELD_S = 3.0
_MIN_NOTE_S, _MAX_NOTE_S, _NUM_NOTES = 0.3, 1.2, 24
_STEPS = (0, 2, 4, 7, 9, 12)  # semitones above the tonic
_FADE_S = 0.03
_VIBRATO_HZ, _VIBRATO = 5.5, 0.3  # semitones
_JITTER = 0.1  # semitones
_TILT = 0.9  # pole of the pulses' low-pass filter
_ASPIRATION = 0.02  # noise, relative to the pulses


def pink_noise(num_samples: int, rng: np.random.Generator) -> Doubles:
    """Return noise with equal power in every octave and an RMS of 1."""
    spectrum = np.fft.rfft(rng.normal(size=num_samples))
    frequency = np.maximum(np.fft.rfftfreq(num_samples), 20 / SAMPLE_RATE_HZ)
    noise = np.fft.irfft(spectrum / np.sqrt(frequency), num_samples)
    return np.asarray(noise / np.sqrt(np.mean(noise**2)))


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
    """Return keyboard strokes. Each has a click and a weaker click on release."""
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


VOICELESS_SOUNDS: dict[str, Callable[[float], Samples]] = {  # by name; the argument is in seconds
    "plucked strings": music,
    "pink noise": varying_noise,
    "keyboard": keyboard,
    "breathing": breathing,
}


def held_vowels() -> list[Samples]:
    """Return each vowel, held by each voice."""
    rng = np.random.default_rng(6)
    return [
        _normalize(_vowel(formants_hz, pitch_hz, size, _HELD_S, rng))
        for pitch_hz, size in _VOICES
        for formants_hz in _FORMANTS_HZ.values()
    ]


def melodies() -> list[Samples]:
    """Return a melody on changing vowels, sung by each voice."""
    rng = np.random.default_rng(7)
    vowels = list(_FORMANTS_HZ.values())
    sung = []
    for tonic_hz, size in _VOICES:
        notes = []
        for _ in range(_NUM_NOTES):
            formants_hz = vowels[int(rng.integers(len(vowels)))]
            pitch_hz = tonic_hz * _TWELFTH ** int(rng.choice(_STEPS))
            seconds = rng.uniform(_MIN_NOTE_S, _MAX_NOTE_S)
            notes.append(_vowel(formants_hz, pitch_hz, size, seconds, rng, _VIBRATO))
        sung.append(_normalize(np.concatenate(notes)))
    return sung


def _vowel(
    formants_hz: Sequence[float],
    pitch_hz: float,
    size: float,
    seconds: float,
    rng: np.random.Generator,
    vibrato: float = 0.0,
) -> Doubles:
    """Synthesize a vowel. ``size`` scales the formants; ``vibrato`` is in semitones."""
    num_samples = round(seconds * SAMPLE_RATE_HZ)
    time_s = np.arange(num_samples) / SAMPLE_RATE_HZ
    knots = rng.normal(0, _JITTER, round(10 * seconds) + 2)
    semitones = np.interp(time_s, np.linspace(0, seconds, len(knots)), knots)
    semitones += vibrato * np.sin(2 * np.pi * _VIBRATO_HZ * time_s)
    phase = np.cumsum(pitch_hz * 2 ** (semitones / 12)) / SAMPLE_RATE_HZ
    sound = np.diff(np.floor(phase), prepend=0.0) + rng.normal(0, _ASPIRATION, num_samples)
    sound = lfilter([1.0], [1.0, -_TILT], sound - sound.mean())
    for formant_hz, bandwidth_hz in zip(formants_hz, _BANDWIDTHS_HZ, strict=True):
        radius = np.exp(-np.pi * bandwidth_hz / SAMPLE_RATE_HZ)
        angle = 2 * np.pi * formant_hz * size / SAMPLE_RATE_HZ
        poles = [1.0, -2 * radius * np.cos(angle), radius**2]
        sound = lfilter([sum(poles)], poles, sound)
    distance_s = np.minimum(time_s, time_s[::-1])  # from the start or the end
    faded: Doubles = sound * np.minimum(1.0, distance_s / _FADE_S)
    return faded


def _normalize(sound: Doubles) -> Samples:
    """Scale to -26 dB full scale, the level of speech near a microphone."""
    return as_samples(sound / np.sqrt(np.mean(sound**2)) * 0.05)


def as_samples(sound: NDArray[np.floating]) -> Samples:
    """Convert to 32-bit floats; clip them at full scale."""
    clipped: Samples = np.clip(sound, -1.0, 1.0).astype(np.float32)
    return clipped
