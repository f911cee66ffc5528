"""Sung and held voice, generated from speech with a vocoder.

The vocoder splits speech into pitch, spectral envelope and aperiodicity, every 5 ms. Voiced frames
are repeated with the pitch of a random melody, or one voiced frame is held for seconds. Each frame
keeps the mouth position of its source frame.

Source: Morise, Yokomori and Ozawa 2016, "WORLD: a vocoder-based high-quality speech synthesis
system for real-time applications" (pyworld).
"""

from dataclasses import dataclass

import numpy as np
import pyworld
from scipy.ndimage import uniform_filter1d

from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.shared.arrays import Doubles, Floats, Integers, Mask

_FRAME_S = 0.005
_PITCH_FRAMES_PER_ENCODER_FRAME = 4
_MIDDLE_FRAME = 3.5  # middle of encoder frame 0, pitch frames
_MIN_VOICED = 20  # frames
_MIN_STRETCH, _MAX_STRETCH = 1.3, 3.0  # for voiced frames
_MIN_HOLD_S, _MAX_HOLD_S, _HOLD_PROB = 1.0, 4.0, 0.5
_MIN_NOTE_S, _MAX_NOTE_S = 0.2, 0.9
_STEPS = (-5, -3, 0, 0, 2, 4, 7, 9, 12)  # semitones of a note from the tonic
_MIN_TONIC, _MAX_TONIC = -3.0, 6.0  # semitones from the speaker's pitch
_GLIDE_FRAMES = 14  # between notes
_MIN_VIBRATO_HZ, _MAX_VIBRATO_HZ, _MAX_VIBRATO = 4.5, 6.5, 0.5  # semitones
_MIN_PITCH_HZ, _MAX_PITCH_HZ = 70.0, 900.0


@dataclass(frozen=True, slots=True)
class SungVoice:
    """A sung or held copy of speech."""

    samples: Floats  # 16 kHz
    source: Integers  # (positions,) the position of the speech
    is_sung: Mask  # (positions,) False in the spoken parts before and after a hold
    pitch: Floats  # (positions,) log2 of Hz, NaN without voice


def sing(samples: Floats, num_positions: int, rng: np.random.Generator) -> SungVoice | None:
    """Sing speech, (n,) at 16 kHz, or hold one of its vowels; None without enough voice."""
    sound = samples.astype(np.float64)
    pitch_hz, time_s = pyworld.dio(sound, SAMPLE_RATE_HZ)
    pitch_hz = pyworld.stonemask(sound, pitch_hz, time_s, SAMPLE_RATE_HZ)
    voiced = pitch_hz > 0
    if voiced.sum() < _MIN_VOICED:
        return None
    envelope = pyworld.cheaptrick(sound, pitch_hz, time_s, SAMPLE_RATE_HZ)
    aperiodicity = pyworld.d4c(sound, pitch_hz, time_s, SAMPLE_RATE_HZ)
    is_melody = rng.random() < 0.5
    frames, is_sung = _stretch(voiced, envelope, rng, is_melody=is_melody)
    new_pitch_hz = pitch_hz[frames]
    if is_melody:
        new_pitch_hz = np.where(voiced[frames], _melody(new_pitch_hz, rng), 0.0)
    sung = pyworld.synthesize(new_pitch_hz, envelope[frames], aperiodicity[frames], SAMPLE_RATE_HZ)
    sung /= max(1.0, np.abs(sung).max())
    middle = (
        _PITCH_FRAMES_PER_ENCODER_FRAME * np.arange(len(frames) // _PITCH_FRAMES_PER_ENCODER_FRAME)
        + 3
    )
    source = (frames[middle] - _MIDDLE_FRAME) / _PITCH_FRAMES_PER_ENCODER_FRAME
    with np.errstate(divide="ignore"):
        pitch = np.log2(new_pitch_hz[middle])
    return SungVoice(
        samples=sung.astype(np.float32),
        source=np.clip(np.rint(source), 0, num_positions - 1).astype(np.int64),
        is_sung=is_sung[middle],
        pitch=np.where(np.isfinite(pitch), pitch, np.nan).astype(np.float32),
    )


def _stretch(
    voiced: Mask, envelope: Doubles, rng: np.random.Generator, *, is_melody: bool
) -> tuple[Integers, Mask]:
    """Repeat voiced frames for a melody. Hold a loud frame; in a melody, only sometimes.

    Return the source frame of each new frame, and whether it is sung or held.
    """
    stretch = rng.uniform(_MIN_STRETCH, _MAX_STRETCH) if is_melody else 1.0
    durations = np.where(voiced, stretch, 1.0)
    held = -1
    if not is_melody or rng.random() < _HOLD_PROB:
        power = envelope.sum(axis=1) * voiced
        held = int(rng.choice(np.argsort(power)[-int(voiced.sum()) // 4 :]))  # a voiced frame
        durations[held] += rng.uniform(_MIN_HOLD_S, _MAX_HOLD_S) / _FRAME_S
    ends = np.cumsum(durations)
    source = np.searchsorted(ends, np.arange(int(ends[-1])), side="right")
    return source, np.full(len(source), True) if is_melody else source == held


def _melody(pitch_hz: Doubles, rng: np.random.Generator) -> Doubles:
    """Draw a pitch for every frame, Hz."""
    spoken_hz = np.median(pitch_hz[pitch_hz > 0])
    notes: list[float] = []
    while len(notes) < len(pitch_hz):
        length = int(rng.uniform(_MIN_NOTE_S, _MAX_NOTE_S) / _FRAME_S)
        notes += length * [float(rng.choice(_STEPS))]
    semitones = uniform_filter1d(np.array(notes[: len(pitch_hz)]), _GLIDE_FRAMES)
    vibrato_hz = rng.uniform(_MIN_VIBRATO_HZ, _MAX_VIBRATO_HZ)
    phase = 2 * np.pi * vibrato_hz * _FRAME_S * np.arange(len(pitch_hz))
    semitones += rng.uniform(0.0, _MAX_VIBRATO) * np.sin(phase) + rng.uniform(
        _MIN_TONIC, _MAX_TONIC
    )
    melody: Doubles = spoken_hz * 2 ** (semitones / 12)
    return np.clip(melody, _MIN_PITCH_HZ, _MAX_PITCH_HZ)
