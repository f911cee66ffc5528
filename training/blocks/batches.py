"""Batches for the block network: clean speech for the teacher, disturbed speech for the network.

The disturbances are those of :mod:`kouxing.training.neural.augmentation`, and background speech,
clipping and lossy coding.

An excerpt is cut from the concatenated recordings, and its speed is drawn. The teacher sees it
clean, and slightly longer than the network does. A tempo is drawn for the frames of both. Every
batch has its own random generator, so resumed training gives the same network.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import soundfile
import torch
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from torch import Tensor

from kouxing.corpora.feature_cache import as_floats
from kouxing.services.recognizer.front_end.features import HOP_SAMPLES, SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.whisper_mel import FLOOR_BANDS, NUM_MELS, WhisperMel
from kouxing.training.neural.augmentation import (
    Samples,
    change_speed,
    change_tempo,
    disturb,
    scale_level,
    source_frames,
)
from kouxing.training.neural.batches import Recording, Targets, sampling_probs

BATCH_S = 32
_POSITIONS_PER_S = 50
_LENGTHS = (80, 120, 160, 200)  # positions of an excerpt
_BEYOND = 25  # further positions that only the teacher sees
_BLOCK_LENGTHS, _BLOCK_PROBS = (5, 10, 20), (0.2, 0.4, 0.4)
_FROM_START_PROB = 0.5  # of a recording
_FIRST_ROW_PROB, _MAX_START = 0.7, 1200  # row of the table of positions
_DISTURB_PROB, _TEMPO_PROB, _HURRY_PROB = 0.9, 0.3, 0.4
_MAX_STRETCH = 2.2  # frames needed for an excerpt of any speed and tempo
_MAX_SHORTENING = 0.7  # of a frame that resembles its neighbors
_STEADY_FRAMES = 5  # steadiness is averaged over them
_TEACHER_PEAK = 0.5
_BABBLE_PROB, _MAX_VOICES, _MIN_BABBLE_DB, _MAX_BABBLE_DB = 0.15, 3, 0.0, 20.0
_CLIP_PROB, _MIN_CLIPPED = 0.1, 0.15  # lowest limit, of the peak
_CODEC_PROB = 0.2
_CODED_PEAK, _MIN_COMPRESSION, _MAX_COMPRESSION = 0.5, 0.3, 0.98
_CODECS = (("MP3", "MPEG_LAYER_III"), ("OGG", "OPUS"))
_TINY = 1e-9

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockBatch:
    """Excerpts of a step."""

    frames: Tensor  # (batch, 2 positions + 1, 80), the network's input
    clean: Tensor  # (batch, 80, more frames), the teacher's input
    states: Tensor  # (batch, positions, 2, k), the targets
    probs: Tensor  # (batch, positions, 2, k)
    block_length: int
    start: int  # row of the first position


def block_batch(recordings: Sequence[Recording], seed: int, number: int) -> BlockBatch:
    """Draw the batch with this number."""
    rng = np.random.default_rng([seed, number])
    probs = sampling_probs(recordings)
    length = int(rng.choice(_LENGTHS))
    num_frames = 2 * (length + _BEYOND) + 1
    disturbed, clean, states, target_probs = [], [], [], []
    for _ in range(_POSITIONS_PER_S * BATCH_S // length):
        samples, targets = _speech(recordings, probs, math.ceil(_MAX_STRETCH * num_frames), rng)
        both, source = _frames(samples, len(targets), recordings, rng)
        bands = both[:num_frames, :NUM_MELS]
        clean.append(np.maximum(bands, bands.max() - FLOOR_BANDS).T)
        disturbed.append(both[: 2 * length + 1, NUM_MELS:])
        target = targets.of(source[: 2 * length])
        states.append(target.states.astype(np.int64))
        target_probs.append(target.probs.astype(np.float32))
    shape = len(states), length, 2, -1
    return BlockBatch(
        frames=torch.from_numpy(np.stack(disturbed)),
        clean=torch.from_numpy(np.stack(clean)),
        states=torch.from_numpy(np.stack(states)).view(*shape),
        probs=torch.from_numpy(np.stack(target_probs)).view(*shape),
        block_length=int(rng.choice(_BLOCK_LENGTHS, p=_BLOCK_PROBS)),
        start=0 if rng.random() < _FIRST_ROW_PROB else int(rng.integers(_MAX_START)),
    )


def _speech(
    recordings: Sequence[Recording],
    probs: NDArray[np.float64],
    num_frames: int,
    rng: np.random.Generator,
) -> tuple[Samples, Targets]:
    """Draw recordings until they fill the frames; the first may start anywhere."""
    sounds, states, target_probs = [], [], []
    missing = num_frames
    while missing > 0:
        recording = recordings[int(rng.choice(len(probs), p=probs))]
        size = len(recording.targets)
        start_frame = 0
        if missing == num_frames and size > num_frames and rng.random() >= _FROM_START_PROB:
            start_frame = int(rng.integers(size - num_frames))
        size = min(size - start_frame, missing)
        sounds.append(recording.samples[HOP_SAMPLES * start_frame :][: HOP_SAMPLES * size])
        target = recording.targets.of(slice(start_frame, start_frame + size))
        states.append(target.states)
        target_probs.append(target.probs)
        missing -= size
    targets = Targets(np.concatenate(states), np.concatenate(target_probs))
    return as_floats(np.concatenate(sounds)), targets


def _frames(
    samples: Samples, num_source: int, recordings: Sequence[Recording], rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int64]]:
    """Compute frames, clean and disturbed, (n, 160), and their source frames, (n,)."""
    sound, speed = change_speed(samples, rng)
    sound = (sound * (_TEACHER_PEAK / (np.abs(sound).max() + _TINY))).astype(np.float32)
    disturbed = sound
    if rng.random() < _DISTURB_PROB:
        disturbed = _distort(disturb(_add_babble(sound, recordings, rng), rng), rng)
    frames = np.hstack(
        [WhisperMel().accept_waveform(one) for one in (sound, scale_level(disturbed, rng))]
    )
    source = source_frames(len(frames), speed, num_source)
    draw = rng.random()
    if draw < _TEMPO_PROB + _HURRY_PROB:
        frames, changed = (change_tempo if draw < _TEMPO_PROB else _shorten_steady_sounds)(
            frames, rng
        )
        source = source[changed]
    return frames, source


def _shorten_steady_sounds(
    frames: Floats, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int64]]:
    """Shorten steady sounds, like fast speakers.

    Return frames, (m, k), and their source frames, (m,).
    """
    change = np.abs(np.diff(frames[:, :NUM_MELS], axis=0, prepend=frames[:1, :NUM_MELS]))
    change = uniform_filter1d(change.mean(axis=1), _STEADY_FRAMES)
    steady = 1 / (1 + np.square(change / (np.median(change) + _TINY)))
    durations = 1 - rng.uniform(0, _MAX_SHORTENING) * steady
    ends = np.cumsum(durations)
    kept = np.searchsorted(ends, np.arange(ends[0], ends[-1]))
    return frames[kept], kept


def _add_babble(
    sound: Samples, recordings: Sequence[Recording], rng: np.random.Generator
) -> Samples:
    if rng.random() >= _BABBLE_PROB:
        return sound
    babble = np.zeros_like(sound)
    for _ in range(int(rng.integers(1, _MAX_VOICES + 1))):
        voice = as_floats(recordings[int(rng.integers(len(recordings)))].samples)
        babble += np.resize(voice, len(sound)) / (np.sqrt(np.mean(voice**2)) + _TINY)
    below_db = rng.uniform(_MIN_BABBLE_DB, _MAX_BABBLE_DB)
    level = np.sqrt(np.mean(sound**2) / np.mean(babble**2)) * 10 ** (-below_db / 20)
    return sound + np.float32(level) * babble


def _distort(sound: Samples, rng: np.random.Generator) -> Samples:
    """Clip, or code and decode, at random; the peak becomes 1/2."""
    peak = np.abs(sound).max() + _TINY
    if rng.random() < _CLIP_PROB:
        peak *= np.exp(rng.uniform(np.log(_MIN_CLIPPED), 0.0))
        sound = np.clip(sound, -peak, peak)
    sound = (sound * (_CODED_PEAK / peak)).astype(np.float32)
    if rng.random() >= _CODEC_PROB:
        return sound
    kind, codec = _CODECS[int(rng.integers(len(_CODECS)))]
    file = io.BytesIO()
    level = rng.uniform(_MIN_COMPRESSION, _MAX_COMPRESSION)
    soundfile.write(
        file, sound, SAMPLE_RATE_HZ, format=kind, subtype=codec, compression_level=level
    )
    file.seek(0)
    decoded: Samples = soundfile.read(file, dtype="float32")[0]
    return np.resize(decoded, len(sound))
