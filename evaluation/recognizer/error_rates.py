"""Error rates and delays of the recognizer.

Measured for offline decoding and for the live output rule (Li et al. 2011, eq. 4) with several
parameters:

- phone error rate: insertions, deletions and substitutions per reference phone, without silence, by
  speaker, with a bootstrap interval over speakers;
- viseme error rate: the same for mouth shapes (Li 2011, table 1). Compound vowels are split. Equal
  neighbors count once, because the mouth does not move between them;
- emission delay: media time when a phone is first emitted, minus its onset by forced alignment.

A live recognizer has two hypotheses. The first hypothesis holds each phone as first emitted, by the
rule or, unlike in the paper, along with the next phone. The final hypothesis holds the corrected
phones. Every recording is a separate session, so the live mean starts from the prior each time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.scoring import (
    ErrorCounts,
    count_errors,
    final_hypothesis,
    first_hypothesis,
    matched_pairs,
)
from kouxing.corpora.speech_corpus import RowErrors, Utterance, read_corpus, syllables_of
from kouxing.evaluation.recognizer.labials import Labials
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.alignment import align_phones, spoken
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.services.recognizer.live_decoder import LiveDecoder
from kouxing.services.recognizer.offline import decode_offline
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.services.recognizer.speech_scorer import ScoreEvent, SpeechScorer, score_streams
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

Samples = NDArray[np.float32]
# The paper's rule, and rules that use only confident frames.
RULES = tuple(
    OutputRuleConfig(*parameters)
    for parameters in ((1, 0.0), (3, 0.0), (5, 0.0), (3, 0.95), (3, 0.99), (1, 0.98))
)
CHUNK_SAMPLES = 160  # 10 ms, as live audio arrives
_NUM_RESAMPLES = 2000


@dataclass(slots=True, kw_only=True)
class Score:
    """Errors and delays of one output on all recordings. Counts are by speaker."""

    name: str
    phones: dict[str, ErrorCounts] = field(default_factory=dict)  # live: of the first hypothesis
    visemes: dict[str, ErrorCounts] = field(default_factory=dict)
    final_phones: dict[str, ErrorCounts] = field(default_factory=dict)
    final_visemes: dict[str, ErrorCounts] = field(default_factory=dict)
    delays_s: list[float] = field(default_factory=list)

    def summary(self, rng: np.random.Generator) -> dict[str, object]:
        """Return rates, intervals and delay percentiles for a JSON file."""
        out: dict[str, object] = {"output": self.name}
        for measure in ("phone", "viseme", "final_phone", "final_viseme"):
            by_speaker: dict[str, ErrorCounts] = getattr(self, f"{measure}s")
            if not by_speaker:
                continue
            total = sum(by_speaker.values(), ErrorCounts())
            out[f"{measure}_error_rate"] = total.rate
            out[f"{measure}_interval_95"] = bootstrap_interval(list(by_speaker.values()), rng)
            out[f"{measure}_errors"] = asdict(total)
            out[f"{measure}_errors_by_speaker"] = {
                speaker: {"rate": counts.rate, **asdict(counts)}
                for speaker, counts in sorted(by_speaker.items())
            }
        if self.delays_s:
            p50, p95 = np.percentile(self.delays_s, [50, 95])
            out["delay_ms"] = {"p50": 1000 * float(p50), "p95": 1000 * float(p95)}
        return out


def mouth_shapes(phones: Iterable[str], inventory: PhoneInventory) -> list[str]:
    """Return the shapes that the mouth goes through (Li 2011, table 1), equal neighbors once."""
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
    errors = np.array([c.insertions + c.deletions + c.substitutions for c in by_speaker])
    lengths = np.array([c.reference for c in by_speaker])
    picks = rng.integers(len(by_speaker), size=(_NUM_RESAMPLES, len(by_speaker)))
    rates = errors[picks].sum(axis=1) / np.maximum(1, lengths[picks].sum(axis=1))
    low, high = np.percentile(rates, [2.5, 97.5])
    return float(low), float(high)


def evaluate_recognizer(
    model: AcousticModel,
    corpus: Path,
    split: str,
    default_rule: OutputRuleConfig,
    *,
    audio: Path | None = None,
    rules: Sequence[OutputRuleConfig] = RULES,
) -> dict[str, object]:
    """Measure a model on one split of a corpus in the model's language; return JSON figures.

    The score of ``default_rule`` is the last one, after those of ``rules``. In the figures,
    ``labials`` has the consonants made with the lips, and ``bad_rows`` lists rows that could not be
    used. Raises UserError if the split has no usable recording.
    """
    inventory = model.inventory
    errors = RowErrors()
    utterances = read_corpus(corpus, errors, inventory, split=split, audio=audio)
    rules = [*(rule for rule in rules if rule != default_rule), default_rule]
    offline = Score(name="offline decoding")
    live = [Score(name=_rule_name(rule)) for rule in rules]
    labials = {output: Labials(inventory) for output in ("offline", "first", "final")}
    used: list[Utterance] = []
    seconds = 0.0
    for utterance in track(utterances, description=f"recognizing {split}"):
        try:
            samples = read_audio(utterance.path)
            syllables = syllables_of(utterance, inventory)
            truth = spoken(align_phones(model, samples, SAMPLE_RATE_HZ, syllables), inventory)
        except (UserError, ValueError) as error:
            errors.add(utterance.utterance_id, str(error))
            continue
        used.append(utterance)
        seconds += len(samples) / SAMPLE_RATE_HZ
        reference = _Reference(truth, utterance.speaker, inventory)
        scored = _score(model, samples)
        decoded = decode_offline(model, (event for _, events in scored for event in events))
        recognized = spoken(decoded, inventory)
        reference.count(recognized, offline.phones, offline.visemes)
        # Offline decoding emits everything when the recording ends.
        offline.delays_s += [len(samples) / SAMPLE_RATE_HZ - phone.onset_s for phone in truth]
        for score, rule in zip(live, rules, strict=True):
            output = _decode_live(model, scored, rule)
            reference.count(output.first, score.phones, score.visemes)
            reference.count(output.final, score.final_phones, score.final_visemes)
            score.delays_s += reference.delays_s(output)
        hypotheses = {"offline": recognized, "first": output.first, "final": output.final}
        for name, phones in hypotheses.items():
            labials[name].add(reference.phones, [phone.symbol for phone in phones])
    if not used:
        raise UserError(
            f"{corpus} has no usable recordings in the split {split!r}; choose another split"
            + "".join(f"\n{message}" for message in errors.messages[:5])
        )
    rng = np.random.default_rng(0)
    return {
        "split": split,
        "recordings": len(used),
        "speakers": len({utterance.speaker for utterance in used}),
        "seconds": seconds,
        "bad_rows": errors.messages,
        "scores": [score.summary(rng) for score in (offline, *live)],
        "labials": {output: counts.rates() for output, counts in labials.items()},
    }


def _rule_name(rule: OutputRuleConfig) -> str:
    confidence = f", conf. {rule.min_confidence}" if rule.min_confidence else ""
    return f"N = {rule.num_stable_frames}{confidence}"


def _score(model: AcousticModel, samples: Samples) -> list[tuple[float, list[ScoreEvent]]]:
    """Score a recording live; return media time in seconds and the new events, by chunk."""
    scorer = SpeechScorer(model)
    scored = []
    for start in range(0, len(samples), CHUNK_SAMPLES):
        chunk = samples[start : start + CHUNK_SAMPLES]
        scorer.accept_waveform(chunk)
        score_streams(model, [scorer])
        scored.append(((start + len(chunk)) / SAMPLE_RATE_HZ, scorer.get_events()))
    scorer.input_finished()
    score_streams(model, [scorer])
    return [*scored, (len(samples) / SAMPLE_RATE_HZ, scorer.get_events())]


@dataclass(slots=True)
class _LiveOutput:
    first: list[Phone] = field(default_factory=list)
    emitted_s: list[float] = field(default_factory=list)  # media time of each of ``first``
    final: list[Phone] = field(default_factory=list)


def _decode_live(
    model: AcousticModel,
    scored: Sequence[tuple[float, list[ScoreEvent]]],
    rule: OutputRuleConfig,
) -> _LiveOutput:
    decoder = LiveDecoder(model.topology, rule)
    output = _LiveOutput()
    known: set[int] = set()
    for time_s, scores in scored:
        events = decoder.decode(scores)
        output.final += spoken(final_hypothesis(events), model.inventory)
        first = spoken(first_hypothesis(events, known), model.inventory)
        output.first += first
        output.emitted_s += [time_s] * len(first)
    return output


@dataclass(frozen=True, slots=True)
class _Reference:
    """The true phones of a recording."""

    truth: Sequence[Phone]
    speaker: str
    inventory: PhoneInventory

    @property
    def phones(self) -> list[str]:
        return [phone.symbol for phone in self.truth]

    def count(
        self,
        recognized: Sequence[Phone],
        phones: dict[str, ErrorCounts],
        visemes: dict[str, ErrorCounts],
    ) -> None:
        """Add the errors of recognized phones to the speaker's counts."""
        pair = self.phones, [phone.symbol for phone in recognized]
        shapes = (mouth_shapes(symbols, self.inventory) for symbols in pair)
        for counts, new in ((phones, count_errors(*pair)), (visemes, count_errors(*shapes))):
            counts[self.speaker] = counts.get(self.speaker, ErrorCounts()) + new

    def delays_s(self, output: _LiveOutput) -> list[float]:
        """Return the emission delays of phones that are right in the first hypothesis."""
        symbols = [phone.symbol for phone in output.first]
        return [
            output.emitted_s[j] - self.truth[i].onset_s
            for i, j in matched_pairs(self.phones, symbols)
            if i is not None and j is not None and self.phones[i] == symbols[j]
        ]
