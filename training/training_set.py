"""The training set: recordings with features, phones and weights.

Corpora are unbalanced. One speaker reads words for three hours, thirty others read one sentence
each, and a synthesizer makes any amount. The weight of a recording is

    w = clip(sqrt(30 min / minutes of its speaker), 0.3, 3) * (0.3 if synthetic)
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kouxing.corpora.feature_cache import log_mel_of, samples_of
from kouxing.corpora.speech_corpus import RowErrors, Utterance, audio_files, read_corpus
from kouxing.services.recognizer.front_end.features import HOP_SAMPLES, WINDOW_SAMPLES
from kouxing.shared.arrays import Float16, Int16
from kouxing.shared.phones.inventory import PhoneInventory

FRAMES_PER_MINUTE = 6000
_SYNTHETIC_WEIGHT = 0.3  # relative to natural speech; chosen on development data
_NEUTRAL_MINUTES = 30.0  # a speaker with this much speech has weight 1
_MIN_WEIGHT, _MAX_WEIGHT = 0.3, 3.0
_MIN_FRAMES_PER_PHONE = 3
_MARGIN_FRAMES = 25  # silence that is kept at both ends
_MIN_PIECE_FRAMES = 20  # shorter recordings without text are skipped
_MAX_PIECE_FRAMES = 2000  # longer recordings without text are cut


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """One recording to train on."""

    log_mel: Float16  # (frames, 41)
    samples: Int16  # (n,) 16 kHz, the samples of these frames
    phones: tuple[int, ...]  # indices into the inventory's phones
    syllables: tuple[int, ...]  # number of phones in each syllable
    weight: float  # weight of its frames in the estimates
    license: str
    speech_kind: str  # see ``Utterance.speech_kind``
    speaker: str

    @property
    def minutes(self) -> float:
        """Duration without outer silence."""
        return len(self.log_mel) / FRAMES_PER_MINUTE


def load_examples(
    corpora: Sequence[Path],
    errors: RowErrors,
    inventory: PhoneInventory,
    *,
    any_license: bool,
    split: str = "train",
) -> list[Example]:
    """Read the recordings of one split, with their log-mel features, samples and weights.

    ``errors`` receives a message for every row that cannot be used. For ``any_license``, see
    :func:`read_corpus`. Raises ``UserError`` if no recording can be used.
    """
    utterances: list[Utterance] = []
    log_mels: list[Float16 | None] = []
    sounds: list[Int16] = []
    for corpus in corpora:
        rows = read_corpus(corpus, errors, inventory, split=split, any_license=any_license)
        utterances += rows
        log_mels += log_mel_of(rows, errors)
        sounds += samples_of(rows)
    weights = weights_of(utterances)
    examples = []
    for utterance, weight, log_mel, sound in zip(
        utterances, weights, log_mels, sounds, strict=True
    ):
        if log_mel is None:
            continue
        span = speech_span(log_mel)
        trimmed = np.asarray(log_mel[span])
        if len(trimmed) < _MIN_FRAMES_PER_PHONE * len(utterance.phones):
            errors.add(utterance.utterance_id, "its text is longer than its sound")
            continue
        examples.append(
            Example(
                log_mel=trimmed,
                samples=sound[_samples_of(span, len(trimmed))],
                phones=utterance.phones,
                syllables=utterance.syllables,
                weight=weight,
                license=utterance.license,
                speech_kind=utterance.speech_kind,
                speaker=utterance.speaker,
            )
        )
    if not examples:
        raise errors.no_recording_error(f"of split {split!r} in {', '.join(map(str, corpora))}")
    return examples


def weights_of(utterances: Sequence[Utterance]) -> list[float]:
    """Return the weight of each recording, as above."""
    minutes: dict[str, float] = defaultdict(float)
    for utterance in utterances:
        minutes[utterance.speaker] += utterance.seconds / 60
    weights = []
    for utterance in utterances:
        weight = np.sqrt(_NEUTRAL_MINUTES / minutes[utterance.speaker])
        weight = float(np.clip(weight, _MIN_WEIGHT, _MAX_WEIGHT))
        weights.append(weight * (_SYNTHETIC_WEIGHT if utterance.is_synthetic else 1.0))
    return weights


def load_untranscribed(folder: Path, errors: RowErrors) -> list[Int16]:
    """Read recordings without text, in any language, except those held out for measuring.

    Returns samples at 16 kHz, trimmed and cut into pieces of up to 20 s. ``errors`` receives a
    message for every file that cannot be used. Raises ``UserError`` if no file can be used.
    """
    files = [Utterance(utterance_id=str(path), path=path) for path in audio_files(folder)]
    sounds = samples_of(files)
    pieces = []
    for file, log_mel, sound in zip(files, log_mel_of(files, errors), sounds, strict=True):
        if log_mel is None:
            continue
        span = speech_span(log_mel)
        num_frames = len(log_mel[span])
        if num_frames < _MIN_PIECE_FRAMES:
            errors.add(file.utterance_id, "it is too short")
        for start in range(0, num_frames - _MIN_PIECE_FRAMES + 1, _MAX_PIECE_FRAMES):
            piece = slice(span.start + start, span.stop)
            pieces.append(sound[_samples_of(piece, min(_MAX_PIECE_FRAMES, num_frames - start))])
    if not pieces:
        raise errors.no_recording_error(f"in {folder}")
    return pieces


def speech_span(log_mel: Float16) -> slice:
    """Find the frames from a quarter of a second before the speech to as long after it."""
    log_energy = np.asarray(log_mel[:, 0], dtype=np.float32)
    low, high = np.percentile(log_energy, [5, 95])
    loud = np.flatnonzero(log_energy >= low + 0.3 * (high - low))
    return slice(max(0, int(loud[0]) - _MARGIN_FRAMES), int(loud[-1]) + 1 + _MARGIN_FRAMES)


def _samples_of(span: slice, num_frames: int) -> slice:
    """Return the range of samples behind the first ``num_frames`` frames of a span."""
    first = HOP_SAMPLES * span.start
    return slice(first, first + HOP_SAMPLES * (num_frames - 1) + WINDOW_SAMPLES)
