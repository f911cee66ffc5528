"""Live error rates of universal phones by language, compared with another recognizer.

======  ============================================================================================
name    recognizer
======  ============================================================================================
auto    the universal model, without a choice of language
own     the model of the recording's language: the universal model restricted to its phones. The
        phones of the Mandarin model are converted to universal phones
hama    hama, whole recordings of English only
======  ============================================================================================

All recognizers get the same recordings. The measures are phonetic feature errors, phone
errors and viseme errors. The final hypothesis equals an offline search.
"""

import subprocess
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from kouxing.evaluation.recognizer.aligned_corpus import AlignedRecording
from kouxing.evaluation.recognizer.error_rates import (
    ErrorStats,
    Recognition,
    recognize_live,
    score_live,
)
from kouxing.evaluation.rivals.tables import FOLDER, find_installed
from kouxing.services.recognizer.acoustic.languages import load_model_for_language
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.command.terminal import CONSOLE
from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import UNIVERSAL, find_language, load_inventory
from kouxing.shared.phones.universal.segments import read_ipa

AUTO, OWN, HAMA = "auto", "own", "hama"
_HAMA_LANGUAGE = "en"


def evaluate_languages(
    references: Sequence[AlignedRecording], rule: OutputRuleConfig, *, with_hama: bool
) -> dict[str, dict[str, Any]]:
    """Measure the recognizers; return figures in the form of ``evaluate_recognizer``.

    A language is a code such as ``en`` or ``en-GRID``. Raises ``UserError`` if a recording's
    language is unknown, or hama is not installed.
    """
    scores: dict[str, dict[str, ErrorStats]] = defaultdict(
        lambda: defaultdict(lambda: ErrorStats(load_inventory(UNIVERSAL)))
    )
    for reference in track(references, "recognizing", console=CONSOLE, transient=True):
        for name, recognition in _recognitions(reference, rule):
            scores[name][reference.group].add(reference, recognition)
    if with_hama:
        english = [reference for reference in references if _code_of(reference) == _HAMA_LANGUAGE]
        for reference, phones in zip(english, _run_hama(english), strict=True):
            recognition = Recognition(final=[_phone(symbol) for symbol in phones])
            scores[HAMA][reference.group].add(reference, recognition)
    rng = np.random.default_rng(0)
    results: dict[str, dict[str, Any]] = {}
    for name, by_language in scores.items():
        speech = {group: score.summary(rng) for group, score in sorted(by_language.items())}
        if name == HAMA:
            for summary in speech.values():
                del summary["first"]
        scored = [reference for reference in references if reference.group in by_language]
        results[name] = {
            "recordings": len(scored),
            "speakers": len({reference.utterance.speaker for reference in scored}),
            "speech": speech,
        }
    return results


def _code_of(reference: AlignedRecording) -> str:
    return reference.utterance.language.partition("-")[0]


def _recognitions(
    reference: AlignedRecording, rule: OutputRuleConfig
) -> Iterator[tuple[str, Recognition]]:
    samples, universal = reference.read_audio(), load_model_for_language(UNIVERSAL)
    scored = score_live(universal, samples)
    yield AUTO, recognize_live(universal, scored, rule)
    own_model = load_model_for_language(find_language(_code_of(reference)))
    if own_model.inventory.language == UNIVERSAL:
        yield OWN, recognize_live(own_model, scored, rule)
        return
    recognition = recognize_live(own_model, score_live(own_model, samples), rule)
    in_universal = own_model.inventory.universal
    first = [[replace(p, symbol=s) for s in in_universal[p.symbol]] for p in recognition.first]
    final = [[replace(p, symbol=s) for s in in_universal[p.symbol]] for p in recognition.final]
    emitted_s = [
        time_s for time_s, phones in zip(recognition.emitted_s, first, strict=True) for _ in phones
    ]
    yield OWN, Recognition([*chain(*first)], emitted_s, [*chain(*final)])


def _phone(symbol: str) -> Phone:
    return Phone(index=0, symbol=symbol, onset_s=0.0, duration_s=0.1, confidence=1.0, final=True)


def _run_hama(references: Sequence[AlignedRecording]) -> Iterator[tuple[str, ...]]:
    """Yield the phones of each recording; raises ``UserError`` if hama outputs unknown letters."""
    with tempfile.TemporaryDirectory() as name:
        for number, reference in enumerate(references):
            reference.read_audio().astype("<f4").tofile(Path(name) / f"{number:06}.f32")
        command = [str(find_installed(".venv/bin/python")), "hama_phones.py", name]
        done = subprocess.run(  # noqa: S603
            command, cwd=FOLDER, capture_output=True, encoding="utf-8", check=False
        )
    if done.returncode:
        raise UserError(f"hama failed: {done.stderr[-500:]}")
    for line in done.stdout.splitlines():
        phones, unknown = read_ipa(line)
        if unknown:
            raise UserError(f"hama wrote {unknown[0]!r}, which is not in other_ipa.tsv; add it")
        yield phones
