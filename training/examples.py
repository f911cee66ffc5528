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

from shared.errors import UserError
from training import SYNTHETIC_WEIGHT
from training.augmentation import Augmentation
from training.corpus import RowErrors, Utterance, is_synthetic, may_ship, read_corpus
from training.feature_cache import log_mel_of

_EVEN_MINUTES = 30.0
_LEAST_WEIGHT, _MOST_WEIGHT = 0.3, 3.0
WORD_UNITS = 8  # a recording of at most so many units is a word, not connected speech
_MARGIN_FRAMES = 25  # of silence left at both ends


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
    voices: tuple[NDArray[np.float16], ...] = ()  # the same in other voices, (frames, 41) each


def load_examples(
    corpora: Sequence[Path],
    errors: RowErrors,
    *,
    split: str = "train",
    shipping: bool = True,
    synthetic_weight: float = SYNTHETIC_WEIGHT,
    num_voices: int = 0,
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
    num_voices
        Other voices for each real sentence, see :mod:`training.voice_change`; one for each word.

    Raises
    ------
    UserError
        If nothing is left.
    """
    utterances: list[Utterance] = []
    log_mels: list[NDArray[np.float16] | None] = []
    for corpus in corpora:
        rows = read_corpus(corpus, errors, split=split)
        if shipping:
            closed = [row for row in rows if not may_ship(row.licence)]
            for row in closed:
                errors.add(row.utterance_id, f"its licence ({row.licence or 'none'}) is not free")
            rows = [row for row in rows if may_ship(row.licence)]
        utterances += rows
        log_mels += log_mel_of(rows, errors)
    voices = _voices_of(utterances, num_voices)
    minutes: dict[str, float] = defaultdict(float)
    for utterance in utterances:
        minutes[utterance.speaker] += utterance.seconds / 60
    examples = []
    for utterance, log_mel in zip(utterances, log_mels, strict=True):
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
                voices=tuple(np.asarray(v[span]) for v in voices.get(utterance.utterance_id, ())),
            )
        )
    if not examples:
        raise UserError(
            f"no usable recordings of split {split!r} in {', '.join(map(str, corpora))}; "
            "see the messages about rows"
        )
    return examples


def _voices_of(
    utterances: Sequence[Utterance], num_voices: int
) -> dict[str, list[NDArray[np.float16]]]:
    """Other voices of the real recordings, by utterance: one of each word, more of a sentence."""
    real = [utterance for utterance in utterances if not is_synthetic(utterance.licence)]
    if not (num_voices and real):
        return {}
    from training.voice_change import changed_voices  # noqa: PLC0415 (needs an extra of its own)

    sentences = [utterance for utterance in real if len(utterance.units) > WORD_UNITS]
    words = [utterance for utterance in real if len(utterance.units) <= WORD_UNITS]
    voices = [
        *zip(sentences, changed_voices(sentences, num_voices=num_voices), strict=True),
        *zip(words, changed_voices(words, num_voices=1), strict=True),
    ]
    return {utterance.utterance_id: blocks for utterance, blocks in voices}


def speech_span(log_mel: NDArray[np.float16]) -> slice:
    """Frames without the long silence at both ends, of which a quarter of a second is left."""
    log_energy = np.asarray(log_mel[:, 0], dtype=np.float32)
    low, high = np.percentile(log_energy, [5, 95])
    loud = np.flatnonzero(log_energy >= low + 0.3 * (high - low))
    return slice(max(0, int(loud[0]) - _MARGIN_FRAMES), int(loud[-1]) + 1 + _MARGIN_FRAMES)
