"""Training utterances with their features, weights and which of them may be used.

A corpus is never even: one speaker read words for three hours, thirty others one sentence each, and
a synthesiser goes on for ever. An utterance's weight in the estimates is

    w = clip(sqrt(30 min / minutes of its speaker), 0.3, 3) * (synthetic_weight if synthetic)
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.recognizer.features import HOP_SAMPLES, WINDOW_SAMPLES
from training import SYNTHETIC_WEIGHT
from training.augmentation import Augmentation
from training.corpus import (
    RowErrors,
    Utterance,
    audio_files,
    is_synthetic,
    may_ship,
    read_corpus,
)
from training.feature_cache import log_mel_of, samples_of

_EVEN_MINUTES = 30.0
_LEAST_WEIGHT, _MOST_WEIGHT = 0.3, 3.0
WORD_UNITS = 8  # a recording of at most so many units is a word, not connected speech
_MARGIN_FRAMES = 25  # of silence left at both ends
_LEAST_FRAMES = 20  # of a recording without text
_MOST_FRAMES = 2000  # likewise; longer ones are cut into pieces


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """One training utterance."""

    log_mel: NDArray[np.float16]  # (frames, 41)
    units: tuple[int, ...]
    syllables: tuple[int, ...]  # units in each syllable
    weight: float  # of its frames in the estimates
    licence: str = ""
    speaker: str = ""
    augmentation: Augmentation | None = None
    samples: NDArray[np.int16] | None = None  # (n,) 16 kHz, those of the frames


def load_examples(
    corpora: Sequence[Path],
    errors: RowErrors,
    *,
    split: str = "train",
    shipping: bool = True,
    synthetic_weight: float = SYNTHETIC_WEIGHT,
    with_samples: bool = False,
) -> list[Example]:
    """Read corpora, compute or fetch their log-mel features, and weigh the utterances.

    Parameters
    ----------
    corpora
        Folders that :func:`training.corpus.read_corpus` reads.
    errors
        Receives a message for every row that cannot be used.
    split
        Split to take.
    shipping
        Leave out rows whose licence forbids giving the model away.
    synthetic_weight
        Weight of rows whose licence says they are synthetic.
    with_samples
        Give the examples their samples too.

    Raises
    ------
    UserError
        If nothing is left.
    """
    utterances: list[Utterance] = []
    log_mels: list[NDArray[np.float16] | None] = []
    sounds: list[NDArray[np.int16] | None] = []
    for corpus in corpora:
        rows = read_corpus(corpus, errors, split=split)
        if shipping:
            closed = [row for row in rows if not may_ship(row.licence)]
            for row in closed:
                errors.add(row.utterance_id, f"its licence ({row.licence or 'none'}) is not free")
            rows = [row for row in rows if may_ship(row.licence)]
        utterances += rows
        log_mels += log_mel_of(rows, errors)
        sounds += samples_of(rows) if with_samples else [None] * len(rows)
    minutes: dict[str, float] = defaultdict(float)
    for utterance in utterances:
        minutes[utterance.speaker] += utterance.seconds / 60
    examples = []
    for utterance, log_mel, sound in zip(utterances, log_mels, sounds, strict=True):
        if log_mel is None:
            continue
        span = speech_span(log_mel)
        trimmed = np.asarray(log_mel[span])
        if len(trimmed) < 3 * len(utterance.units):
            errors.add(utterance.utterance_id, "its text is longer than its sound")
            continue
        weight = np.sqrt(_EVEN_MINUTES / minutes[utterance.speaker])
        weight = float(np.clip(weight, _LEAST_WEIGHT, _MOST_WEIGHT))
        if is_synthetic(utterance.licence):
            weight *= synthetic_weight
        examples.append(
            Example(
                log_mel=trimmed,
                units=utterance.units,
                syllables=utterance.syllables,
                weight=weight,
                licence=utterance.licence,
                speaker=utterance.speaker,
                samples=None if sound is None else sound[_samples_of(span, len(trimmed))],
            )
        )
    if not examples:
        raise errors.nothing_left(f"of split {split!r} in {', '.join(map(str, corpora))}")
    return examples


def load_untranscribed(folders: Sequence[Path], errors: RowErrors) -> list[NDArray[np.int16]]:
    """Read recordings without text, in any language.

    Parameters
    ----------
    folders
        Folders with audio files, at any depth.
    errors
        Receives a message for every file that cannot be used.

    Returns
    -------
    list
        Samples at 16 kHz without the long silence at both ends, in pieces of 20 s at most.

    Raises
    ------
    UserError
        If a folder holds no audio files, or none of them can be used.
    """
    pieces = []
    for folder in folders:
        files = [_file_without_text(path) for path in audio_files(folder)]
        sounds = samples_of(files)
        for file, log_mel, sound in zip(files, log_mel_of(files, errors), sounds, strict=True):
            if log_mel is None:
                continue
            span = speech_span(log_mel)
            num_frames = len(log_mel[span])
            if num_frames < _LEAST_FRAMES:
                errors.add(file.utterance_id, "it is too short")
            for start in range(0, num_frames - _LEAST_FRAMES + 1, _MOST_FRAMES):
                piece = slice(span.start + start, span.stop)
                pieces.append(sound[_samples_of(piece, min(_MOST_FRAMES, num_frames - start))])
    if not pieces:
        raise errors.nothing_left(f"in {', '.join(map(str, folders))}")
    return pieces


def _file_without_text(path: Path) -> Utterance:
    return Utterance(
        utterance_id=str(path),
        path=path,
        speaker="",
        source="",
        licence="",
        split="",
        seconds=0.0,
        units=(),
        syllables=(),
    )


def speech_span(log_mel: NDArray[np.float16]) -> slice:
    """Frames without the long silence at both ends, of which a quarter of a second is left."""
    log_energy = np.asarray(log_mel[:, 0], dtype=np.float32)
    low, high = np.percentile(log_energy, [5, 95])
    loud = np.flatnonzero(log_energy >= low + 0.3 * (high - low))
    return slice(max(0, int(loud[0]) - _MARGIN_FRAMES), int(loud[-1]) + 1 + _MARGIN_FRAMES)


def _samples_of(span: slice, num_frames: int) -> slice:
    """Find the samples that so many frames from the beginning of a span are computed from."""
    first = HOP_SAMPLES * span.start
    return slice(first, first + HOP_SAMPLES * (num_frames - 1) + WINDOW_SAMPLES)
