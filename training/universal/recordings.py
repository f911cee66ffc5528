"""Reads the recordings on which the universal readout is trained.

Whole speakers and two languages are held out, to measure errors for unseen speakers and languages.
"""

import random
import zlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from kouxing.corpora.lip_clips import read_clips
from kouxing.corpora.speech_corpus import (
    RowErrors,
    Utterance,
    may_distribute,
    read_corpus,
    syllables_of,
)
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import UNIVERSAL, load_inventory

_MANDARIN_LIMITS = {"sentence": 560, "word": 350, "synthetic": 450}  # limits for a corpus
_MAX_OF_SPEAKER = 13  # recordings of a speaker of English by native speakers of Mandarin
_LEARNERS_LICENSE = "CC BY 4.0"  # license of speechocean762, whose manifest has no licenses
_MAX_S = 25.0
_HELD_OUT_LANGUAGES = ("it", "ko")
_HELD_OUT_SPEAKERS = frozenset(
    "emodb_03 emodb_13 vctk_p226 lj_linda_johnson "
    "grid_s31 grid_s33 grid_s5 grid_m_lbax grid_f_lbbc".split()
)
_HELD_OUT_EVERY = 10  # one in 10 speakers of English by native speakers of Mandarin
# fraction of each group in training; synthetic speech other than Mandarin has _SYNTHETIC_FRACTION
_FRACTIONS = {"learners": 0.27, "mandarin": 0.15, "en": 0.10, "emodb": 0.10, "grid": 0.08,
              "fr": 0.07, "es": 0.06, "ru": 0.06, "de": 0.04, "yue": 0.04, "pt": 0.03}  # fmt: skip
_SYNTHETIC_FRACTION = 0.16


def read_training_set(
    mandarin: Sequence[Path],
    learners: Sequence[Path],
    languages: Sequence[Path],
    clips: Path | None,
    errors: RowErrors,
    *,
    any_license: bool,
) -> tuple[list[Utterance], dict[str, float]]:
    """Read the recordings that are not held out, and their sampling weights by id.

    ``mandarin`` are Mandarin corpora, ``learners`` English by native speakers of Mandarin,
    ``languages`` corpora of several languages, and ``clips`` a folder with clips of GRID. Without
    ``any_license``, their license must allow distributing the model. Raises ``UserError`` if
    nothing can be used.
    """
    groups: dict[str, list[Utterance]] = defaultdict(list)
    for corpus in mandarin:
        groups["mandarin"] += _sample_mandarin(corpus, errors, any_license=any_license)
    for corpus in learners:
        groups["learners"] += _sample_speakers(corpus, errors)
    universal = load_inventory(UNIVERSAL)
    for corpus in languages:
        for recording in read_corpus(corpus, errors, universal, any_license=any_license):
            groups[_group_of(recording)].append(recording)
    if clips:
        groups["grid"] += _grid_clips(clips, errors)
    recordings: list[Utterance] = []
    weights: dict[str, float] = {}
    for name, group in sorted(groups.items()):
        usable = [
            recording
            for recording in group
            if _may_train(recording) and (any_license or may_distribute(recording.license))
        ]
        total_s = sum(recording.seconds for recording in usable)
        recordings += usable
        fraction = _FRACTIONS.get(name, _SYNTHETIC_FRACTION)
        for recording in usable:
            weights[recording.utterance_id] = fraction * recording.seconds / total_s
    if not recordings:
        raise errors.no_recording_error("in the corpora")
    return recordings, weights


def _group_of(recording: Utterance) -> str:
    if recording.speaker.startswith("emodb_"):
        return "emodb"
    return "synthetic" if recording.is_synthetic else recording.language


def _may_train(recording: Utterance) -> bool:
    return (
        recording.seconds <= _MAX_S
        and recording.language not in _HELD_OUT_LANGUAGES
        and recording.speaker not in _HELD_OUT_SPEAKERS
        and recording.split != "test"
    )


def _sample_mandarin(corpus: Path, errors: RowErrors, *, any_license: bool) -> list[Utterance]:
    """Draw some recordings of each kind, with universal phones."""
    mandarin, universal = load_inventory(), load_inventory(UNIVERSAL)
    rows = read_corpus(corpus, errors, mandarin, split="train", any_license=any_license)
    random.Random(3).shuffle(rows)  # noqa: S311 - reproducible
    by_kind: dict[str, list[Utterance]] = defaultdict(list)
    for row in rows:
        by_kind[row.speech_kind].append(row)
    drawn = [
        row for kind, recordings in by_kind.items() for row in recordings[: _MANDARIN_LIMITS[kind]]
    ]
    converted = []
    for row in drawn:
        words = [mandarin.in_universal_phones(word) for word in syllables_of(row, mandarin)]
        phones = tuple(universal.index[phone] for word in words for phone in word)
        converted.append(replace(row, phones=phones, syllables=tuple(map(len, words))))
    return converted


def _sample_speakers(corpus: Path, errors: RowErrors) -> list[Utterance]:
    by_speaker: dict[str, list[Utterance]] = defaultdict(list)
    for row in read_corpus(corpus, errors, load_inventory(UNIVERSAL)):
        by_speaker[row.speaker].append(row)
    drawn = []
    for speaker, rows in sorted(by_speaker.items()):
        random.Random(speaker).shuffle(rows)  # noqa: S311 - reproducible
        if zlib.crc32(speaker.encode()) % _HELD_OUT_EVERY:
            chosen = rows[:_MAX_OF_SPEAKER]
            drawn += [replace(row, license=row.license or _LEARNERS_LICENSE) for row in chosen]
    return drawn


def _grid_clips(folder: Path, errors: RowErrors) -> list[Utterance]:
    english, universal = load_inventory("english"), load_inventory(UNIVERSAL)
    clips = []
    for clip in read_clips(folder, language="en"):
        if clip.source != "grid" or not clip.transcript:
            continue
        try:
            words = english.pronounce(clip.transcript)
        except UserError as error:
            errors.add(clip.name, str(error))
            continue
        clips.append(
            Utterance(
                utterance_id=clip.name,
                path=folder / f"{clip.name}.flac",
                speaker=clip.speaker,
                license=clip.license,
                language=clip.language,
                seconds=60 * clip.minutes,
                phones=tuple(universal.index[phone] for word in words for phone in word),
                syllables=tuple(map(len, words)),
            )
        )
    return clips
