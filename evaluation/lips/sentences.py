"""Test sentences: from a corpus, from clips of tracked lips, or the samples of the package."""

import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.lip_clips import LipClip, aligned_phones
from kouxing.corpora.speech_corpus import RowErrors, Utterance, read_corpus, syllables_of
from kouxing.evaluation.lips.references import clips_to_score
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.offline.alignment import align_syllables
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone

NUM_SENTENCES = 20  # as in Li et al. 2011
_MEAN_S = 4.0  # mean length of the paper's sentences


@dataclass(frozen=True, slots=True)
class Sentence:
    """A recording, with its phones by forced alignment if its text is known."""

    clip: LipClip  # without frames if there are no tracked lips
    aligned: list[Phone] | None


def sample_sentences(model: AcousticModel, folder: Path) -> list[Sentence]:
    """Read a folder with ``transcripts.tsv``, which has the columns ``file text voice``."""
    with (folder / "transcripts.tsv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    clips = [
        _make_clip(model, folder / row["file"], Path(row["file"]).stem, row["voice"], row["text"])
        for row in rows
    ]
    return [Sentence(clip, aligned_phones(model, clip)) for clip in clips]


def corpus_sentences(model: AcousticModel, corpus: Path) -> list[Sentence]:
    """Read twenty sentences of the split ``test``; raises ``UserError`` if the split is empty."""
    errors = RowErrors()
    utterances = read_corpus(corpus, errors, model.inventory, split="test")
    if not utterances:
        raise errors.no_recording_error(f"in the split 'test' of {corpus}")
    sentences = []
    for utterance in choose_utterances(utterances):
        clip = _make_clip(model, utterance.path, utterance.utterance_id, utterance.speaker)
        syllables = syllables_of(utterance, model.inventory)
        phones = align_syllables(model, clip.samples, syllables).phones
        sentences.append(Sentence(clip, phones))
    return sentences


def choose_utterances(utterances: Sequence[Utterance]) -> list[Utterance]:
    """Choose twenty utterances, equally many of each speaker, preferably about 4 s long."""
    by_speaker: dict[str, list[Utterance]] = defaultdict(list)
    for utterance in sorted(utterances, key=lambda u: (abs(u.seconds - _MEAN_S), u.utterance_id)):
        by_speaker[utterance.speaker].append(utterance)
    rounds = zip_longest(*(by_speaker[speaker] for speaker in sorted(by_speaker)))
    ranked = [utterance for turn in rounds for utterance in turn if utterance is not None]
    return sorted(ranked[:NUM_SENTENCES], key=lambda utterance: utterance.utterance_id)


def clip_sentences(model: AcousticModel, folder: Path) -> list[Sentence]:
    """Read all held-out clips of tracked lips in the model's language."""
    clips = clips_to_score(folder, language=model.inventory.code)
    return [Sentence(clip, aligned_phones(model, clip)) for clip in clips]


def _make_clip(
    model: AcousticModel, path: Path, name: str, speaker: str, text: str = ""
) -> LipClip:
    return LipClip(
        name=name,
        speaker=speaker,
        language=model.inventory.code,
        split="held",
        transcript=text,
        time_s=np.zeros(0),
        faps=np.zeros((0, len(MOUTH_FAPS))),
        samples=read_audio(path),
    )
