"""How well the recognizer hears what a laboratory's recordings leave out.

Phone errors of the same sentences disturbed (:mod:`evaluation.disturbances`), and how many units a
minute it hears in sounds that hold no Mandarin.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from evaluation.disturbances import SOUNDS, SPEECH_CONDITIONS
from evaluation.recognizer import ErrorCounts, count_errors, first_said, once_final
from services.recognizer.acoustic_model import AcousticModel
from services.recognizer.features import SAMPLE_RATE_HZ
from services.recognizer.pipeline import Recognizer, ScoreEvent, full_traceback, scores_of
from shared.phones import UNITS, Phone, SpeechChange
from training.align import spoken
from training.corpus import RowErrors, audio_files, read_corpus
from training.feature_cache import read_audio

_SOUND_S = 60.0
_OTHER_RECORDINGS = 40  # of another language


def evaluate_robustness(
    model: AcousticModel, corpus: Path, split: str, *, other_language: Path | None = None
) -> dict[str, Any]:
    """Measure a model on disturbed speech and on what is no Mandarin.

    Parameters
    ----------
    model
        The acoustic model.
    corpus
        A corpus folder, or a manifest, that :func:`training.corpus.read_corpus` reads.
    split
        Its split, such as ``dev`` or ``test``.
    other_language
        Folder of recordings in another language; forty of them are heard.

    Returns
    -------
    dict
        ``speech``: by condition the phone error rates of the full traceback, of the units as
        first said and of those once final; ``sounds``: units a minute by sound.

    Raises
    ------
    UserError
        If there is no such corpus or split, or no recording in the other folder.
    """
    utterances = read_corpus(corpus, RowErrors(), split=split)
    recordings = [
        ([UNITS[unit] for unit in utterance.units], read_audio(utterance.path))
        for utterance in utterances
    ]
    speech = {}
    for name, disturbed in track(SPEECH_CONDITIONS.items(), description="disturbed speech"):
        totals = {"full": ErrorCounts(), "first": ErrorCounts(), "final": ErrorCounts()}
        for said, samples in recordings:
            for output, heard in _outputs(model, disturbed(samples)).items():
                totals[output] += count_errors(said, heard)
        speech[name] = {output: counts.rate for output, counts in totals.items()}
    sounds = {name: _units_a_minute(model, [make(_SOUND_S)]) for name, make in SOUNDS.items()}
    if other_language is not None:
        sounds["other language"] = _units_a_minute(model, recordings_in(other_language))
    return {"split": split, "recordings": len(recordings), "speech": speech, "sounds": sounds}


def print_robustness(results: dict[str, dict[str, Any]], console: Console) -> None:
    """Print the figures of several models as two tables."""
    for name, figures in results.items():
        columns = ("phone error %", "full traceback", "as first said", "once final")
        table = Table(*columns, title=f"{name}, {figures['split']}")
        for condition, rates in figures["speech"].items():
            cells = (f"{100 * rates[output]:.1f}" for output in ("full", "first", "final"))
            table.add_row(condition, *cells)
        console.print(table)
        table = Table("sound without Mandarin", "units a minute", title=name)
        for sound, rate in figures["sounds"].items():
            table.add_row(sound, f"{rate:.1f}")
        console.print(table)


def _outputs(model: AcousticModel, samples: NDArray[np.float32]) -> dict[str, list[str]]:
    """Units by the full traceback, as first said, and once final."""
    scores = scores_of(model, samples, SAMPLE_RATE_HZ)
    live = _live(model, scores)
    outputs = {
        "full": full_traceback(model, scores),
        "first": first_said(live, set()),
        "final": once_final(live),
    }
    return {name: [phone.unit for phone in spoken(phones)] for name, phones in outputs.items()}


def _live(model: AcousticModel, scores: Sequence[ScoreEvent]) -> list[Phone | SpeechChange]:
    return Recognizer(model, sample_rate_hz=SAMPLE_RATE_HZ).follow(scores)


def _units_a_minute(model: AcousticModel, sounds: Sequence[NDArray[np.float32]]) -> float:
    minutes = sum(len(samples) for samples in sounds) / SAMPLE_RATE_HZ / 60
    heard = [_live(model, scores_of(model, samples, SAMPLE_RATE_HZ)) for samples in sounds]
    return sum(len(spoken(once_final(said))) for said in heard) / minutes


def recordings_in(folder: Path) -> list[NDArray[np.float32]]:
    """Read some of the recordings in a folder, evenly spread; UserError if there is none."""
    found = audio_files(folder)
    step = max(1, len(found) // _OTHER_RECORDINGS)
    return [read_audio(path) for path in found[::step][:_OTHER_RECORDINGS]]
