"""Batches for the audio encoder: augmented speech with the targets of the clean recordings.

An excerpt joins recordings, with pauses between some of them. Its random speed also shifts pitch
and formants. Music, voices or noise are added in the background, then the augmentations of
:mod:`kouxing.training.networks.augmentation` are applied. Some excerpts contain only a background.
Every batch has its own random generator, so resumed training gives the same network.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.services.mouth_profiles.lip_inputs import ENCODER_FRAME_S
from kouxing.services.recognizer.acoustic.encoder import LIP_DELAYS_S, VoiceKind
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.shared.arrays import Doubles, Float16, Floats
from kouxing.shared.audio.pcm import as_floats
from kouxing.training.encoder.network import NUM_INPUTS
from kouxing.training.encoder.targets import PITCH, VOICE, Piece, Samples, TargetColumns
from kouxing.training.encoder.teachers import ENCODER_FRAME_SAMPLES
from kouxing.training.networks.augmentation import (
    Sound,
    add_sounds,
    change_speed,
    disturb,
    scale_level,
)
from kouxing.training.seed import SEED

Batch = tuple[Float16, Float16]  # inputs, (batch, positions, 160); targets

NUM_ENCODER_FRAMES = 250  # length of an excerpt, 5 s
NUM_EXCERPTS = 28
BATCH_S = NUM_EXCERPTS * NUM_ENCODER_FRAMES * ENCODER_FRAME_SAMPLES / SAMPLE_RATE_HZ
_MAX_SPEED = 1.3
_MAX_PIECE = 400  # positions of one recording in an excerpt
_PAUSE_PROB, _MAX_PAUSE = 0.5, 75  # positions
_LEVEL_DB = 5.0  # deviation of the levels of recordings in an excerpt
_MIDDLE = 0.875  # middle of a position's frames, positions after its first sample
_KNOWN = 2.25  # end of the audio that the network has received, likewise
_CLEAN_PROB, _BACKGROUND_PROB = 0.15, 0.65
_VOICES_PROB, _MAX_VOICES = 0.35, 6  # for a background with other speakers
_MIN_BABBLE = 4  # voices of a background without a near voice
_MIN_SNR_DB, _MAX_SNR_DB = 0.0, 25.0
_MIN_PITCH, _MAX_PITCH = 0.75, 1.33  # for music and noise
_TINY = 1e-9


@dataclass(frozen=True, slots=True)
class BatchSource:
    """Recordings and background sounds from which batches are drawn."""

    pieces: Sequence[Piece]
    backgrounds: Sequence[Samples]  # music and noise
    columns: TargetColumns
    background_only_prob: float = 0.08  # of an excerpt without speech
    babble_only_prob: float = 0.0  # of voices in the background of such an excerpt

    def draw(self, rng: np.random.Generator, probs: Doubles) -> Piece:
        """Draw a piece; ``probs`` are the cumulative probabilities."""
        return self.pieces[int(np.searchsorted(probs, rng.random() * probs[-1]))]


@dataclass(frozen=True, slots=True)
class Excerpt:
    """Joined recordings, before and after augmentation, at the same speed."""

    clean: Sound
    disturbed: Floats
    targets: Floats  # (source positions, columns)
    speed: float

    def source_positions(self) -> NDArray[np.floating]:
        """Return the source position of each position."""
        return self.speed * np.arange(NUM_ENCODER_FRAMES) + (self.speed - 1) * _MIDDLE


def draw_batch(batch_source: BatchSource, number: int) -> Batch:
    """Draw a batch by its number."""
    columns = batch_source.columns
    rows = [
        (network_inputs(excerpt.disturbed)[:NUM_ENCODER_FRAMES], _target_rows(excerpt, columns))
        for excerpt in draw_excerpts(batch_source, number)
    ]
    inputs, targets = (np.stack(arrays, dtype=np.float16) for arrays in zip(*rows, strict=True))
    return inputs, targets


def draw_excerpts(batch_source: BatchSource, number: int) -> Iterator[Excerpt]:
    """Draw the excerpts of a batch by its number."""
    rng = np.random.default_rng([SEED, number])
    probs = np.cumsum([piece.weight for piece in batch_source.pieces])
    for _ in range(NUM_EXCERPTS):
        yield _draw_excerpt(batch_source, probs, rng)


def network_inputs(samples: Floats) -> Floats:
    """Compute the network's inputs from samples at 16 kHz, (positions, 160)."""
    frames = WhisperMel().accept_waveform(samples)[1:]
    return frames[: len(frames) // 2 * 2].reshape(-1, NUM_INPUTS)


def _draw_excerpt(batch_source: BatchSource, probs: Doubles, rng: np.random.Generator) -> Excerpt:
    samples, targets = _speech(batch_source, probs, rng)
    clean, speed = change_speed(samples, rng)
    sound = clean
    is_only_background = rng.random() < batch_source.background_only_prob
    is_clean = rng.random() < _CLEAN_PROB
    if is_only_background:
        targets[:] = np.nan
        targets[:, VOICE] = VoiceKind.NONE
        others = _background(batch_source, rng, batch_source.babble_only_prob, _MIN_BABBLE)
        sound = add_sounds(sound, others, 0.0, rng) - sound
    elif not is_clean and rng.random() < _BACKGROUND_PROB:
        snr_db = rng.uniform(_MIN_SNR_DB, _MAX_SNR_DB)
        others = _background(batch_source, rng, _VOICES_PROB, 1)
        sound = add_sounds(sound, others, snr_db, rng)
    if not is_clean:
        sound = disturb(sound, rng)
    return Excerpt(clean, scale_level(sound.astype(np.float32), rng), targets, speed)


def _target_rows(excerpt: Excerpt, columns: TargetColumns) -> Floats:
    """Return the targets of each position, (positions, columns) with delayed lips."""
    speed, targets = excerpt.speed, excerpt.targets
    chosen = rows_at(targets, excerpt.source_positions())
    chosen[:, PITCH] += np.float32(np.log2(speed))
    lips = columns.lips
    delayed = [
        rows_at(targets[:, lips], speed * (np.arange(NUM_ENCODER_FRAMES) + known) - 1)
        for known in (_KNOWN - delay_s / ENCODER_FRAME_S for delay_s in LIP_DELAYS_S)
    ]
    return np.concatenate([chosen[:, : lips.start], *delayed], axis=1)


def rows_at(targets: Floats, positions: NDArray[np.floating]) -> Floats:
    """Return the rows that are nearest to positions; NaN before the first one."""
    rows: Floats = targets[np.clip(np.rint(positions).astype(np.int64), 0, len(targets) - 1)]
    rows[positions < -1] = np.nan
    return rows


def _speech(
    batch_source: BatchSource, probs: Doubles, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Join recordings and pauses that are long enough for an excerpt at any speed."""
    sounds: list[Floats] = []
    rows: list[Floats] = []
    missing = int(NUM_ENCODER_FRAMES * _MAX_SPEED)
    while missing > 0:
        piece = batch_source.draw(rng, probs)
        size = min(len(piece.targets), _MAX_PIECE, missing)
        start = int(rng.integers(len(piece.targets) - size + 1))
        sound = as_floats(
            piece.samples[ENCODER_FRAME_SAMPLES * start :][: ENCODER_FRAME_SAMPLES * size]
        )
        gain = 10 ** (rng.normal(0.0, _LEVEL_DB) / 20) / (np.sqrt(np.mean(sound**2)) + _TINY)
        sounds.append(np.float32(gain) * sound)
        rows.append(piece.targets[start : start + size].astype(np.float32))
        missing -= size
        if rng.random() < _PAUSE_PROB:
            size = int(rng.integers(_MAX_PAUSE))
            pause = np.full((size, rows[0].shape[1]), np.nan, np.float32)
            pause[:, VOICE] = VoiceKind.NONE
            rows.append(pause)
            sounds.append(np.zeros(ENCODER_FRAME_SAMPLES * size, np.float32))
            missing -= size
    spare = np.zeros(2 * ENCODER_FRAME_SAMPLES, np.float32)  # for the last positions' windows
    return np.concatenate([*sounds, spare]), np.concatenate(rows)


def _background(
    batch_source: BatchSource, rng: np.random.Generator, voices_prob: float, min_voices: int
) -> list[Samples]:
    """Draw other voices with a probability, otherwise music or noise at a random pitch."""
    if rng.random() < voices_prob:
        num_voices = int(rng.integers(min_voices, _MAX_VOICES + 1))
        numbers = rng.integers(len(batch_source.pieces), size=num_voices)
        return [batch_source.pieces[number].samples for number in numbers]
    number = int(rng.integers(len(batch_source.backgrounds)))
    return [_change_pitch(batch_source.backgrounds[number], rng)]


def _change_pitch(samples: Samples, rng: np.random.Generator) -> Samples:
    """Play a sound faster or slower."""
    positions = np.arange(0, len(samples) - 1, rng.uniform(_MIN_PITCH, _MAX_PITCH))
    changed: Samples = np.interp(positions, np.arange(len(samples)), samples).astype(np.int16)
    return changed
