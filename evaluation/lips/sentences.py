"""Test sentences: of a corpus, of clips of tracked lips, or the samples that come with kouxing."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, aligned_phones
from kouxing.corpora.speech_corpus import RowErrors, Utterance, read_corpus, syllables_of
from kouxing.evaluation.lips.scores import clips_to_score
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.alignment import align_phones
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone

NUM_SENTENCES = 20  # of Li et al. 2011, two of each speaker
_USUAL_S = 4.0  # their mean length


@dataclass(frozen=True, slots=True)
class Sentence:
    """What somebody says."""

    clip: LipClip  # without frames where the lips were not tracked
    aligned: list[Phone] | None  # by its text; None where that is not known


def of_samples(model: AcousticModel, folder: Path) -> list[Sentence]:
    """Sentences of a folder with ``transcripts.tsv``, columns ``file text voice``."""
    with (folder / "transcripts.tsv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    clips = [
        _clip(model, folder / row["file"], Path(row["file"]).stem, row["voice"], row["text"])
        for row in rows
    ]
    return [Sentence(clip, aligned_phones(model, clip)) for clip in clips]


def of_corpus(
    model: AcousticModel, corpus: Path, split: str, audio: Path | None = None
) -> list[Sentence]:
    """Twenty sentences of a split of a corpus, as :func:`choose` chooses them.

    Raises
    ------
    UserError
        If there is no such corpus, or no usable recording in the split.
    """
    errors = RowErrors()
    found = read_corpus(corpus, errors, model.inventory, split=split, audio=audio)
    if not found:
        raise errors.nothing_left(f"in the split {split!r} of {corpus}")
    sentences = []
    for each in choose(found):
        clip = _clip(model, each.path, each.utterance_id, each.speaker)
        syllables = syllables_of(each, model.inventory)
        sentences.append(
            Sentence(clip, align_phones(model, clip.samples, SAMPLE_RATE_HZ, syllables))
        )
    return sentences


def choose(utterances: Sequence[Utterance], number: int = NUM_SENTENCES) -> list[Utterance]:
    """Choose as many of each speaker as of any other, those that last nearly 4 s first."""
    by_speaker: dict[str, list[Utterance]] = defaultdict(list)
    for each in sorted(utterances, key=lambda one: (abs(one.seconds - _USUAL_S), one.utterance_id)):
        by_speaker[each.speaker].append(each)
    rounds = zip_longest(*(by_speaker[speaker] for speaker in sorted(by_speaker)))
    ranked = [each for one in rounds for each in one if each is not None]
    return sorted(ranked[:number], key=lambda one: one.utterance_id)


def of_clips(model: AcousticModel, folder: Path) -> list[Sentence]:
    """All clips of tracked lips that are held out, in the model's language.

    Raises
    ------
    UserError
        If there are none.
    """
    return [
        Sentence(clip, aligned_phones(model, clip))
        for clip in clips_to_score(folder, None, language=model.inventory.code)
    ]


def _clip(model: AcousticModel, path: Path, name: str, speaker: str, text: str = "") -> LipClip:
    """Return a recording as a clip without frames; UserError if it cannot be read."""
    try:
        samples = read_audio(path)
    except ValueError as error:
        raise UserError(str(error)) from error
    return LipClip(
        name=name,
        speaker=speaker,
        license="",
        language=model.inventory.code,
        part="held",
        is_in_sync=True,
        transcript=text,
        time_s=np.zeros(0),
        faps=np.zeros((0, len(MOUTH_FAPS))),
        samples=samples,
    )
