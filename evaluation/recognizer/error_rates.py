"""Error rates and delays of the recognizer, in clean and disturbed speech.

The output rule (Li et al. 2011, eq. 4) is measured in clean speech, by speaking rate, and in
disturbed speech (:mod:`~kouxing.evaluation.recognizer.disturbances`):

- phone error rate: insertions, deletions and substitutions per reference phone, without silence, by
  speaker, with a bootstrap interval over speakers;
- viseme error rate: the same for mouth shapes (Li 2011, table 1). Compound vowels are split. Equal
  neighbors count once, because the mouth does not move between them;
- phonetic feature error rate of universal phones
  (:func:`~kouxing.corpora.scoring.feature_errors`);
- labials: recall and precision of the consonants made with the lips;
- emission delay: media time when a phone is first emitted, minus its onset by forced alignment.

A live recognizer has two hypotheses. The first hypothesis holds each phone as first emitted, by the
rule or, unlike in the paper, along with the next phone. The final hypothesis holds the corrected
phones, which equal the phones of a whole recording. Every recording is a separate session, so the
live mean starts from the prior each time.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from typing import Any

import numpy as np
from rich.progress import track

from kouxing.corpora.scoring import (
    ErrorCounts,
    align_symbols,
    count_errors,
    feature_errors,
    final_hypothesis,
    first_hypothesis,
)
from kouxing.evaluation.percentiles import percentiles
from kouxing.evaluation.recognizer.aligned_corpus import RATE_NAMES, AlignedRecording
from kouxing.evaluation.recognizer.disturbances import CLEAN, Disturb
from kouxing.evaluation.recognizer.synthetic_sounds import Samples
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.services.recognizer.live.live_decoder import LiveDecoder
from kouxing.services.recognizer.live.speech_scorer import ScoreEvent, SpeechScorer, score_streams
from kouxing.services.recognizer.offline.alignment import drop_pauses
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.command.terminal import CONSOLE
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import UNIVERSAL, PhoneInventory

_LABIAL_VISEMES = {"b", "f"}  # of b p m, and of f


class LabialCounts:
    """Counts spoken labials, recognized labials, and labials that are both."""

    def __init__(self, inventory: PhoneInventory) -> None:
        visemes = inventory.visemes
        self._labials = {
            phone for phone in inventory.phones if visemes[phone][0][0] in _LABIAL_VISEMES
        }
        self._num_spoken = self._num_recognized = self._num_both = 0

    def add(self, reference: Sequence[str], recognized: Sequence[str]) -> None:
        """Count the phones of a recording."""
        for i, j in align_symbols(reference, recognized):
            is_spoken = i is not None and reference[i] in self._labials
            is_recognized = j is not None and recognized[j] in self._labials
            self._num_spoken += is_spoken
            self._num_recognized += is_recognized
            self._num_both += is_spoken and is_recognized

    def rates(self) -> dict[str, float | None]:
        """Return recall and precision, or None without phones. Any labial matches any other."""
        return {
            name: self._num_both / total if total else None
            for name, total in (("recall", self._num_spoken), ("precision", self._num_recognized))
        }


# the paper's rule and a rule with fewer errors, which are measured in clean speech
COMPARED_RULES = (OutputRuleConfig(3, 0.0), OutputRuleConfig(3, 0.99))
CHUNK_SAMPLES = 160  # 10 ms, as live audio arrives
HYPOTHESES = ("first", "final")
_NUM_RESAMPLES = 2000


@dataclass(frozen=True, slots=True)
class Recognition:
    """The phones of one recording, by hypothesis, without silence."""

    first: list[Phone] = field(default_factory=list)
    emitted_s: list[float] = field(default_factory=list)  # media time of each of ``first``
    final: list[Phone] = field(default_factory=list)


class ErrorStats:
    """Accumulates errors and delays in one kind of audio."""

    def __init__(self, inventory: PhoneInventory) -> None:
        self._inventory = inventory
        self._num_recordings = 0
        # by hypothesis and unit, then by speaker
        self._counts: dict[tuple[str, str], dict[str, ErrorCounts]] = {
            (hypothesis, unit): defaultdict(ErrorCounts)
            for hypothesis in HYPOTHESES
            for unit in ("phone", "viseme")
        }
        self._feature_errors = dict.fromkeys(HYPOTHESES, 0.0)
        self._labials = {hypothesis: LabialCounts(inventory) for hypothesis in HYPOTHESES}
        self._delays_s: list[float] = []

    def add(self, reference: AlignedRecording, recognition: Recognition) -> None:
        """Count the errors of a recording, and the delays of right first hypotheses."""
        self._num_recordings += 1
        speaker = reference.utterance.speaker
        truth = [phone.symbol for phone in reference.phones]
        for hypothesis in HYPOTHESES:
            symbols = [phone.symbol for phone in getattr(recognition, hypothesis)]
            shapes = (mouth_shapes(phones, self._inventory) for phones in (truth, symbols))
            self._counts[hypothesis, "phone"][speaker] += count_errors(truth, symbols)
            self._counts[hypothesis, "viseme"][speaker] += count_errors(*shapes)
            if self._inventory.language == UNIVERSAL:
                self._feature_errors[hypothesis] += feature_errors(truth, symbols)
            self._labials[hypothesis].add(truth, symbols)
        self._delays_s += [
            recognition.emitted_s[j] - reference.phones[i].onset_s
            for i, j in align_symbols(truth, [phone.symbol for phone in recognition.first])
            if i is not None and j is not None and truth[i] == recognition.first[j].symbol
        ]

    def summary(self, rng: np.random.Generator) -> dict[str, Any]:
        """Return rates, intervals and delay percentiles for a JSON file."""
        out: dict[str, Any] = {"recordings": self._num_recordings}
        for hypothesis in HYPOTHESES:
            out[hypothesis] = {"labials": self._labials[hypothesis].rates()}
        for (hypothesis, unit), by_speaker in self._counts.items():
            total = sum(by_speaker.values(), ErrorCounts())
            out[hypothesis] |= {
                f"{unit}_error_rate": total.rate,
                f"{unit}_interval_95": bootstrap_interval(list(by_speaker.values()), rng),
                f"{unit}_errors": asdict(total),
                f"{unit}_errors_by_speaker": {
                    speaker: {"rate": counts.rate, **asdict(counts)}
                    for speaker, counts in sorted(by_speaker.items())
                },
            }
        if self._inventory.language == UNIVERSAL:
            for hypothesis, errors in self._feature_errors.items():
                rate = errors / max(1, out[hypothesis]["phone_errors"]["reference"])
                out[hypothesis]["feature_error_rate"] = rate
        if self._delays_s:
            out["delay_ms"] = percentiles(1000 * np.array(self._delays_s))
        return out


def mouth_shapes(phones: Iterable[str], inventory: PhoneInventory) -> list[str]:
    """Return the sequence of mouth shapes (Li 2011, table 1), without repeats."""
    shapes = [
        viseme
        for phone in phones
        if phone != inventory.silence
        for viseme, _ in inventory.visemes[phone]
    ]
    return [shape for shape, _ in groupby(shapes)]


def bootstrap_interval(
    by_speaker: Sequence[ErrorCounts], rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return the 95 % interval of the error rate over resampled speakers (Efron 1979).

    None for a single speaker.
    """
    if len(by_speaker) < 2:
        return None
    errors = np.array([c.total for c in by_speaker])
    lengths = np.array([c.reference for c in by_speaker])
    picks = rng.integers(len(by_speaker), size=(_NUM_RESAMPLES, len(by_speaker)))
    rates = errors[picks].sum(axis=1) / np.maximum(1, lengths[picks].sum(axis=1))
    low, high = np.percentile(rates, [2.5, 97.5])
    return float(low), float(high)


def evaluate_recognizer(
    model: AcousticModel,
    references: Sequence[AlignedRecording],
    disturbances: Mapping[str, Disturb],
    rule: OutputRuleConfig,
) -> dict[str, Any]:
    """Measure a model; return figures for a JSON file.

    ``speech`` in the figures contains the scores with ``rule``, by disturbance and speaking rate.
    ``rules`` contains the scores with ``COMPARED_RULES`` in clean speech. ``errors_by_recording``
    contains the errors of the final hypothesis in clean speech by utterance.
    """
    by_recording: dict[str, dict[str, int]] = {}
    speech: dict[str, ErrorStats] = defaultdict(lambda: ErrorStats(model.inventory))
    by_rule: dict[str, ErrorStats] = defaultdict(lambda: ErrorStats(model.inventory))
    for reference in track(references, "recognizing", console=CONSOLE, transient=True):
        samples = reference.read_audio()
        for name, disturb in disturbances.items():
            scored = score_live(model, disturb(samples))
            recognition = recognize_live(model, scored, rule)
            speech[name].add(reference, recognition)
            if name == CLEAN:
                counts = count_errors(
                    [phone.symbol for phone in reference.phones],
                    [phone.symbol for phone in recognition.final],
                )
                by_recording[reference.utterance.utterance_id] = {
                    "phones": counts.reference,
                    "errors": counts.total,
                }
                speech[reference.group].add(reference, recognition)
                for other in COMPARED_RULES:
                    by_rule[_rule_name(other)].add(reference, recognize_live(model, scored, other))
    rng = np.random.default_rng(0)
    return {
        "recordings": len(references),
        "speakers": len({reference.utterance.speaker for reference in references}),
        "speech": {
            name: speech[name].summary(rng)
            for name in sorted(speech, key=[*disturbances, *RATE_NAMES, *speech].index)
        },
        "rules": {name: score.summary(rng) for name, score in by_rule.items()},
        "errors_by_recording": by_recording,
    }


def _rule_name(rule: OutputRuleConfig) -> str:
    confidence = f", conf. {rule.min_confidence}" if rule.min_confidence else ""
    return f"N = {rule.num_stable_frames}{confidence}"


def score_live(model: AcousticModel, samples: Samples) -> list[tuple[float, list[ScoreEvent]]]:
    """Score a recording live; return media time in seconds and the new events, by chunk."""
    scorer = SpeechScorer(model)
    scored = []
    for start in range(0, len(samples), CHUNK_SAMPLES):
        chunk = samples[start : start + CHUNK_SAMPLES]
        scorer.accept_waveform(chunk)
        score_streams([scorer])
        scored.append(((start + len(chunk)) / SAMPLE_RATE_HZ, scorer.get_events()))
    scorer.input_finished()
    score_streams([scorer])
    return [*scored, (len(samples) / SAMPLE_RATE_HZ, scorer.get_events())]


def recognize_live(
    model: AcousticModel, scored: Sequence[tuple[float, list[ScoreEvent]]], rule: OutputRuleConfig
) -> Recognition:
    """Decode the scores of ``score_live``, chunk by chunk."""
    decoder = LiveDecoder(model.topology, rule)
    out = Recognition()
    known: set[int] = set()
    for time_s, scores in scored:
        events = decoder.decode(scores)
        first = drop_pauses(first_hypothesis(events, known), model.inventory)
        out.first.extend(first)
        out.emitted_s.extend([time_s] * len(first))
        out.final.extend(drop_pauses(final_hypothesis(events), model.inventory))
    return out
