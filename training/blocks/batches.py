"""Batches for the block network: clean speech for the teacher, disturbed speech for the network.

The disturbances come from :mod:`kouxing.training.networks.augmentation`, plus background music
and voices, clipping and lossy coding.

An excerpt is cut from the concatenated recordings, at a random speed. The teacher gets it clean,
and slightly longer than the network does. A random tempo applies to the frames of both. Every
batch has its own random generator, so resumed training gives the same network.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import soundfile
from scipy.ndimage import uniform_filter1d

from kouxing.services.recognizer.front_end.features import HOP_SAMPLES, SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.whisper_mel import FLOOR_BANDS, NUM_MELS, WhisperMel
from kouxing.shared.arrays import Doubles, Float16, Floats, Int16, Integers
from kouxing.shared.audio.pcm import as_floats
from kouxing.training.networks.augmentation import (
    Samples,
    add_sounds,
    change_speed,
    disturb,
    scale_level,
    source_frames,
)
from kouxing.training.networks.batches import FrameTargets, LabeledRecording, sampling_probs
from kouxing.training.seed import SEED

BATCH_S = 32
BATCHES_PER_STEP = 8
_ENCODER_FRAMES_PER_S = 50
_LENGTHS = (80, 120, 160, 200)  # positions of an excerpt
_TEACHER_CONTEXT = 25  # additional positions that only the teacher sees
# lengths of a block and its right context, positions: live, then offline
_BLOCKS = ((2, 14), (3, 12), (4, 12), (5, 10), (10, 10), (20, 10), (40, 10))
_BLOCK_PROBS = (0.25, 0.1, 0.1, 0.15, 0.1, 0.2, 0.1)
_FROM_START_PROB = 0.5  # probability that an excerpt begins with the recording
_FIRST_ROW_PROB, _MAX_START = 0.7, 1200  # row of the table of positions
_MAX_SPEED = 1.2
_DISTURB_PROB, _TEMPO_PROB, _HURRY_PROB = 0.9, 0.3, 0.4
_MIN_LOG_TEMPO, _MAX_LOG_TEMPO = -0.2, 0.3
_MAX_SHORTENING = 0.8  # limit for shortening a frame that resembles its neighbors
_MEAN_STEADINESS = 0.6
_STEADY_FRAMES = 5  # steadiness is averaged over them
_TEACHER_PEAK = 0.5
_MUSIC_PROB, _BABBLE_PROB, _MAX_VOICES = 0.25, 0.15, 4
_MIN_SNR_DB, _MAX_SNR_DB = 0.0, 20.0
_CLIP_PROB, _MIN_CLIPPED = 0.1, 0.15  # lowest limit, of the peak
_CODEC_PROB = 0.12
_CODED_PEAK, _MIN_COMPRESSION, _MAX_COMPRESSION = 0.5, 0.3, 0.98
_CODECS = (("MP3", "MPEG_LAYER_III"), ("OGG", "OPUS"))
_TINY = 1e-9


@dataclass(frozen=True, slots=True)
class BatchSource:
    """Recordings and background sounds from which batches are drawn."""

    recordings: Sequence[LabeledRecording]
    backgrounds: Sequence[Int16] = ()  # music and noise


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockBatch:
    """Excerpts of a step."""

    frames: Float16  # (batch, 2 positions + 1, 80), the network's input
    clean: Float16  # (batch, 80, more frames), the teacher's input
    states: Int16  # (batch, positions, 2, k), the targets
    probs: Float16  # (batch, positions, 2, k)
    block: tuple[int, int]  # lengths of a block and its right context, positions
    start: int  # row of the first position


def draw_block_batch(batch_source: BatchSource, number: int) -> BlockBatch:
    """Draw the batch with this number; the batches of a step have the same shape."""
    rng = np.random.default_rng([SEED, number // BATCHES_PER_STEP])
    length = int(rng.choice(_LENGTHS))
    block = _BLOCKS[int(rng.choice(len(_BLOCKS), p=_BLOCK_PROBS))]
    start = 0 if rng.random() < _FIRST_ROW_PROB else int(rng.integers(_MAX_START))
    rng = np.random.default_rng([SEED, 1, number])
    probs = np.cumsum(sampling_probs(batch_source.recordings))
    num_frames = 2 * (length + _TEACHER_CONTEXT) + 1
    disturbed, clean, states, target_probs = [], [], [], []
    for _ in range(_ENCODER_FRAMES_PER_S * BATCH_S // length):
        both, targets = _draw_excerpt(batch_source, probs, num_frames, rng)
        bands = both[:, :NUM_MELS]
        clean.append(np.maximum(bands, bands.max() - FLOOR_BANDS).T)
        disturbed.append(both[: 2 * length + 1, NUM_MELS:])
        states.append(targets.states[: 2 * length])
        target_probs.append(targets.probs[: 2 * length])
    shape = len(states), length, 2, -1
    return BlockBatch(
        frames=np.stack(disturbed).astype(np.float16),
        clean=np.stack(clean).astype(np.float16),
        states=np.stack(states).astype(np.int16).reshape(shape),
        probs=np.stack(target_probs).reshape(shape),
        block=block,
        start=start,
    )


def _draw_excerpt(
    batch_source: BatchSource, probs: Doubles, num_frames: int, rng: np.random.Generator
) -> tuple[Floats, FrameTargets]:
    """Draw an excerpt: frames, clean and disturbed, (num_frames, 160), and their targets."""
    tempo, shortening = 1.0, 0.0
    draw = rng.random()
    if draw < _TEMPO_PROB + _HURRY_PROB:
        tempo = math.exp(rng.uniform(_MIN_LOG_TEMPO, _MAX_LOG_TEMPO))
    if _TEMPO_PROB <= draw < _TEMPO_PROB + _HURRY_PROB:
        tempo = max(tempo, 1.0)
        shortening = rng.uniform(0, _MAX_SHORTENING)
    stretch = tempo / (1 - _MEAN_STEADINESS * shortening)
    num_source = math.ceil(_MAX_SPEED * stretch * num_frames) + 2
    samples, targets = _draw_speech(batch_source.recordings, probs, num_source, rng)
    sound, speed = change_speed(samples, rng)
    sound = sound[: HOP_SAMPLES * (math.ceil(stretch * num_frames) + 3)]
    sound = (sound * (_TEACHER_PEAK / (np.abs(sound).max() + _TINY))).astype(np.float32)
    disturbed = sound
    if rng.random() < _DISTURB_PROB:
        disturbed = _distort(disturb(_add_background(sound, batch_source, rng), rng), rng)
    frames = np.hstack(
        [WhisperMel().accept_waveform(version) for version in (sound, scale_level(disturbed, rng))]
    )
    kept = _shorten(frames, tempo, shortening, num_frames)
    source = source_frames(len(frames), speed, len(targets))
    return frames[kept], targets.select(source[kept])


def _draw_speech(
    recordings: Sequence[LabeledRecording],
    probs: Doubles,
    num_frames: int,
    rng: np.random.Generator,
) -> tuple[Samples, FrameTargets]:
    """Draw recordings until they fill the frames; the first may start anywhere.

    ``probs`` are cumulative.
    """
    sounds, states, target_probs = [], [], []
    missing = num_frames
    while missing > 0:
        recording = recordings[int(np.searchsorted(probs, rng.random() * probs[-1]))]
        size = len(recording.targets)
        start_frame = 0
        if missing == num_frames and size > num_frames and rng.random() >= _FROM_START_PROB:
            start_frame = int(rng.integers(size - num_frames))
        size = min(size - start_frame, missing)
        sounds.append(recording.samples[HOP_SAMPLES * start_frame :][: HOP_SAMPLES * size])
        target = recording.targets.select(slice(start_frame, start_frame + size))
        states.append(target.states)
        target_probs.append(target.probs)
        missing -= size
    targets = FrameTargets(np.concatenate(states), np.concatenate(target_probs))
    return as_floats(np.concatenate(sounds)), targets


def _shorten(frames: Floats, tempo: float, shortening: float, num_frames: int) -> Integers:
    """Choose the frames of faster speech, (num_frames,).

    Steady sounds, which resemble their neighbors, are shortened more, like fast speakers do.
    """
    durations = np.full(len(frames), 1 / tempo)
    if shortening:
        change = np.abs(np.diff(frames[:, :NUM_MELS], axis=0, prepend=frames[:1, :NUM_MELS]))
        change = uniform_filter1d(change.mean(axis=1), _STEADY_FRAMES)
        durations *= 1 - shortening / (1 + np.square(change / (np.median(change) + _TINY)))
    ends = np.cumsum(durations)
    ends *= max(1.0, num_frames / ends[-1])
    chosen = np.searchsorted(ends, np.arange(num_frames) + 0.5)
    return np.minimum(chosen, len(frames) - 1)


def _add_background(sound: Samples, batch_source: BatchSource, rng: np.random.Generator) -> Samples:
    """Add music, noise or other voices of random levels, or nothing."""
    draw = rng.random()
    if draw < _BABBLE_PROB:
        numbers = rng.integers(
            len(batch_source.recordings), size=int(rng.integers(1, _MAX_VOICES + 1))
        )
        others: list[Int16] = [batch_source.recordings[number].samples for number in numbers]
    elif draw < _BABBLE_PROB + _MUSIC_PROB and batch_source.backgrounds:
        others = [batch_source.backgrounds[int(rng.integers(len(batch_source.backgrounds)))]]
    else:
        return sound
    mixed = add_sounds(sound, others, rng.uniform(_MIN_SNR_DB, _MAX_SNR_DB), rng)
    return mixed.astype(np.float32)


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
