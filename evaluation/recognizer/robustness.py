"""Robustness: errors in disturbed speech, and phones recognized in sounds without speech."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.scoring import ErrorCounts, count_errors, final_hypothesis, first_hypothesis
from kouxing.corpora.speech_corpus import RowErrors, audio_files, read_corpus
from kouxing.evaluation.recognizer.disturbances import (
    SOUNDS,
    SPEECH_CONDITIONS,
    Samples,
    add_sound,
    babble,
)
from kouxing.evaluation.recognizer.error_rates import mouth_shapes
from kouxing.evaluation.recognizer.labials import Labials
from kouxing.evaluation.tables import percent
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.alignment import spoken
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.services.recognizer.live_decoder import LiveDecoder
from kouxing.services.recognizer.offline import decode_offline
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.services.recognizer.speech_scorer import score_recording
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.shared.terminal import print_table

_SOUND_S = 60.0
_MAX_OTHER_RECORDINGS = 40
_FINAL = "final_hypothesis"
_OUTPUTS = {  # key of the figures: title of the column
    "offline": "offline decoding",
    "first_hypothesis": "first hypothesis",
    _FINAL: "final hypothesis",
}


def evaluate_robustness(
    model: AcousticModel,
    corpus: Path,
    split: str,
    rule: OutputRuleConfig,
    *,
    audio: Path | None = None,
    other_language: Path | None = None,
) -> dict[str, Any]:
    """Measure a model on disturbed speech and on sounds without its language.

    ``other_language`` is a folder of recordings, of which forty are used. In the result,
    ``speech`` has the error rates and ``labials`` (:class:`Labials`) by condition and output,
    and ``sounds`` the phones per minute by sound. Raises UserError if a folder does not exist or
    has no usable recording.
    """
    phones = model.inventory.phones
    errors = RowErrors()
    recordings = [
        ([phones[phone] for phone in utterance.phones], read_audio(utterance.path))
        for utterance in read_corpus(corpus, errors, model.inventory, split=split, audio=audio)
    ]
    if not recordings:
        raise errors.no_recording_error(f"in the split {split!r} of {corpus}")
    voices = babble([samples for _, samples in recordings])
    conditions: dict[str, Callable[[Samples], Samples]] = {
        **SPEECH_CONDITIONS,
        "babble 10 dB below": lambda samples: add_sound(samples, voices, 10),
    }
    speech = {}
    for name, disturb in track(conditions.items(), description="disturbed speech"):
        tallies = {output: _Tally(model.inventory) for output in _OUTPUTS}
        for reference, samples in recordings:
            for output, recognized in _recognize(model, disturb(samples), rule).items():
                tallies[output].add(reference, recognized)
        speech[name] = {output: tally.rates() for output, tally in tallies.items()}
    sounds = {name: [make(_SOUND_S)] for name, make in SOUNDS.items()}
    if other_language is not None:
        sounds["other language"] = read_recordings(other_language)
    rates = {name: _phones_per_minute(model, each, rule) for name, each in sounds.items()}
    return {"split": split, "recordings": len(recordings), "speech": speech, "sounds": rates}


class _Tally:
    """Errors of one output in one condition."""

    def __init__(self, inventory: PhoneInventory) -> None:
        self._inventory = inventory
        self._phones, self._visemes = ErrorCounts(), ErrorCounts()
        self._labials = Labials(inventory)

    def add(self, reference: Sequence[str], recognized: Sequence[str]) -> None:
        self._phones += count_errors(reference, recognized)
        self._visemes += count_errors(
            mouth_shapes(reference, self._inventory), mouth_shapes(recognized, self._inventory)
        )
        self._labials.add(reference, recognized)

    def rates(self) -> dict[str, Any]:
        return {
            "phone_error_rate": self._phones.rate,
            "viseme_error_rate": self._visemes.rate,
            "labials": self._labials.rates(),
        }


def print_robustness(results: dict[str, dict[str, Any]], console: Console) -> None:
    """Print two tables for each model."""
    labials = "p, b, m, f in the final hypothesis, recall / precision %"
    for name, figures in results.items():
        print_table(
            console,
            f"{name}, {figures['split']}: phone / viseme error %",
            ("speech", *_OUTPUTS.values(), labials),
            (
                [
                    condition,
                    *map(_pair, (*outputs.values(), outputs["final_hypothesis"]["labials"])),
                ]
                for condition, outputs in figures["speech"].items()
            ),
        )
        print_table(
            console,
            name,
            ("sound without speech", "phones per minute"),
            ((sound, f"{rate:.1f}") for sound, rate in figures["sounds"].items()),
        )


def _pair(rates: dict[str, Any]) -> str:
    """Format the first two rates."""
    first, second, *_ = rates.values()
    return f"{percent(first)} / {percent(second)}"


def _recognize(
    model: AcousticModel, samples: Samples, rule: OutputRuleConfig
) -> dict[str, list[str]]:
    """Return the phones of a recording in each of ``_OUTPUTS``."""
    scores = list(score_recording(model, samples, SAMPLE_RATE_HZ))
    events = LiveDecoder(model.topology, rule).decode(scores)
    outputs = {
        "offline": decode_offline(model, scores),
        "first_hypothesis": first_hypothesis(events, set()),
        _FINAL: final_hypothesis(events),
    }
    return {
        name: [phone.symbol for phone in spoken(phones, model.inventory)]
        for name, phones in outputs.items()
    }


def _phones_per_minute(
    model: AcousticModel, sounds: Sequence[Samples], rule: OutputRuleConfig
) -> float:
    minutes = sum(len(samples) for samples in sounds) / SAMPLE_RATE_HZ / 60
    phones = (_recognize(model, samples, rule)[_FINAL] for samples in sounds)
    return sum(map(len, phones)) / minutes


def read_recordings(folder: Path) -> list[Samples]:
    """Read up to forty recordings of a folder, evenly spread; an empty folder is a UserError."""
    paths = audio_files(folder)
    step = max(1, len(paths) // _MAX_OTHER_RECORDINGS)
    return [read_audio(path) for path in paths[::step][:_MAX_OTHER_RECORDINGS]]
