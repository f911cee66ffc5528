"""How well the recognizer hears: error rates, delays, confusions, cost.

Measured for the full traceback and for the live output rule, N = 1 to 6 (Li et al. 2011, eq. 4):

- phone error rate (insertions + deletions + substitutions over the reference's units, ``sil`` not
  counted), by speaker, with a bootstrap interval over speakers;
- viseme error rate: units as mouth shapes (Li 2011, table 1), compound finals split, equal
  neighbours counted once because the mouth does not move between them;
- output delay: media time when a unit is first said, minus its true onset by forced alignment;
- CPU seconds per second of sound, by stage.

Live, the errors are those of what was first said: the units that the rule put out and, unlike in
the paper, those that it passed over and that are said along with the next; then those once final.
Every recording is a session of its own, so the live mean starts from the prior each time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby, zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from services.recognizer.acoustic_model import AcousticModel, listen
from services.recognizer.decoder import Decoder
from services.recognizer.features import SAMPLE_RATE_HZ
from services.recognizer.pipeline import (
    DEFAULT_RULE,
    Recognizer,
    ScoreEvent,
    SpeechScores,
    full_traceback,
)
from services.recognizer.resample import Resampler
from services.recognizer.vad import BLOCK_SAMPLES, VoiceActivityDetector
from services.synthesizer.visemes import SHAPES
from shared.errors import UserError
from shared.phones import SILENCE, UNIT_INDEX, UNITS, Phone, SpeechChange
from training.align import align_units, spoken
from training.corpus import RowErrors, Utterance, read_corpus
from training.feature_cache import read_audio

# N of the output rule and the confidence a frame needs: the paper's rule, its N = 3 with frames
# that are sure, and the recognizer's own
RULES = (
    *((agreement, 0.0) for agreement in (1, 2, 3, 4, 5, 6)),
    (3, 0.95),
    (3, 0.99),
    DEFAULT_RULE,
)
_CHUNK_SAMPLES = 160  # sound is fed as it would arrive, 10 ms at a time
_NUM_RESAMPLES = 2000
_SESSIONS_TOGETHER = 16


@dataclass(slots=True, kw_only=True)
class ErrorCounts:
    """Errors of recognised units against the reference."""

    insertions: int = 0
    deletions: int = 0
    substitutions: int = 0
    reference: int = 0

    @property
    def rate(self) -> float:
        """Errors per reference unit."""
        return (self.insertions + self.deletions + self.substitutions) / max(1, self.reference)

    def __add__(self, other: ErrorCounts) -> ErrorCounts:
        return ErrorCounts(
            insertions=self.insertions + other.insertions,
            deletions=self.deletions + other.deletions,
            substitutions=self.substitutions + other.substitutions,
            reference=self.reference + other.reference,
        )


@dataclass(slots=True, kw_only=True)
class Score:
    """One way of output on all recordings."""

    name: str
    phones: dict[str, ErrorCounts] = field(default_factory=dict)  # by speaker
    visemes: dict[str, ErrorCounts] = field(default_factory=dict)  # by speaker
    final_phones: dict[str, ErrorCounts] = field(default_factory=dict)  # once final, by speaker
    final_visemes: dict[str, ErrorCounts] = field(default_factory=dict)  # likewise
    delays_s: list[float] = field(default_factory=list)

    def summary(self, rng: np.random.Generator) -> dict[str, object]:
        """Rates, intervals and delay percentiles."""
        out: dict[str, object] = {"output": self.name}
        measures = {
            "phone": self.phones,
            "viseme": self.visemes,
            "final_phone": self.final_phones,
            "final_viseme": self.final_visemes,
        }
        for measure, by_speaker in measures.items():
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


def matched_pairs(
    reference: Sequence[str], heard: Sequence[str]
) -> list[tuple[int | None, int | None]]:
    """Align two strings with the fewest errors (Levenshtein 1966).

    Returns
    -------
    list of tuple
        Pairs of positions; None in the first place is an insertion, in the second a deletion.

    Examples
    --------
    >>> matched_pairs(["n", "i"], ["n", "i", "h"])
    [(0, 0), (1, 1), (None, 2)]
    """
    rows, columns = len(reference) + 1, len(heard) + 1
    cost = np.zeros((rows, columns), dtype=np.int64)
    cost[:, 0] = np.arange(rows)
    cost[0] = np.arange(columns)
    for i in range(1, rows):
        for j in range(1, columns):
            change = reference[i - 1] != heard[j - 1]
            cost[i, j] = min(cost[i - 1, j - 1] + change, cost[i - 1, j] + 1, cost[i, j - 1] + 1)
    pairs: list[tuple[int | None, int | None]] = []
    i, j = rows - 1, columns - 1
    while i or j:
        change = bool(i and j and reference[i - 1] != heard[j - 1])
        if i and j and cost[i, j] == cost[i - 1, j - 1] + change:
            i, j = i - 1, j - 1
            pairs.append((i, j))
        elif i and cost[i, j] == cost[i - 1, j] + 1:
            i -= 1
            pairs.append((i, None))
        else:
            j -= 1
            pairs.append((None, j))
    return pairs[::-1]


def count_errors(reference: Sequence[str], heard: Sequence[str]) -> ErrorCounts:
    """Count the fewest insertions, deletions and substitutions between two strings."""
    counts = ErrorCounts(reference=len(reference))
    for i, j in matched_pairs(reference, heard):
        if i is None:
            counts.insertions += 1
        elif j is None:
            counts.deletions += 1
        elif reference[i] != heard[j]:
            counts.substitutions += 1
    return counts


def mouth_shapes(units: Iterable[str]) -> list[str]:
    """Shapes that the mouth goes through (Li 2011, table 1), equal neighbours once."""
    shapes = [shape for unit in units if unit != SILENCE for shape, _ in SHAPES[unit]]
    return [shape for shape, _ in groupby(shapes)]


def bootstrap_interval(
    by_speaker: Sequence[ErrorCounts], rng: np.random.Generator
) -> tuple[float, float] | None:
    """95 % interval of the error rate when speakers are drawn anew (Efron 1979).

    None for a single speaker, who says nothing about others.
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
    *,
    rules: Sequence[tuple[int, float]] = RULES,
) -> dict[str, object]:
    """Measure a model on one split of a corpus.

    Parameters
    ----------
    model
        The acoustic model.
    corpus
        A corpus folder, or a manifest, that :func:`training.corpus.read_corpus` reads.
    split
        Its split, such as ``dev`` or ``test``.
    rules
        Output rules to try: N, and the confidence that a frame needs.

    Returns
    -------
    dict
        Figures for a JSON file; ``confusions`` counts said (row) against heard (column) units, the
        last row and column being nothing. Rows that could not be used are in ``bad_rows``.

    Raises
    ------
    UserError
        If there is no such corpus, or no usable recording in the split.
    """
    errors = RowErrors()
    utterances = read_corpus(corpus, errors, split=split)
    full = Score(name="full traceback")
    live = [
        Score(name=f"N = {agreement}" + (f", sure by {confidence}" if confidence else ""))
        for agreement, confidence in rules
    ]
    confusion = np.zeros((len(UNITS), len(UNITS)), dtype=np.int64)
    used: list[Utterance] = []
    seconds = 0.0
    for utterance in track(utterances, description=f"recognising {split}"):
        try:
            samples = read_audio(utterance.path)
            truth = _truth(model, utterance, samples)
        except (UserError, ValueError) as error:
            errors.add(utterance.utterance_id, str(error))
            continue
        used.append(utterance)
        seconds += len(samples) / SAMPLE_RATE_HZ
        scored = _scored(model, samples)
        heard = spoken(full_traceback(model, (event for _, new in scored for event in new)))
        _count(full.phones, utterance.speaker, _units(truth), _units(heard))
        _count(full.visemes, utterance.speaker, _shapes(truth), _shapes(heard))
        # The full traceback says everything when the recording ends.
        full.delays_s += [len(samples) / SAMPLE_RATE_HZ - phone.onset_s for phone in truth]
        _confuse(confusion, truth, heard)
        for score, rule in zip(live, rules, strict=True):
            phones, said_s, finals = _live(model, scored, rule)
            _count(score.phones, utterance.speaker, _units(truth), _units(phones))
            _count(score.visemes, utterance.speaker, _shapes(truth), _shapes(phones))
            _count(score.final_phones, utterance.speaker, _units(truth), _units(finals))
            _count(score.final_visemes, utterance.speaker, _shapes(truth), _shapes(finals))
            score.delays_s += _delays(truth, phones, said_s)
    if not used:
        raise UserError(
            f"{corpus} has no usable recordings in the split {split!r}; name another split"
            + "".join(f"\n{message}" for message in errors.messages[:5])
        )
    rng = np.random.default_rng(0)
    return {
        "split": split,
        "recordings": len(used),
        "speakers": len({utterance.speaker for utterance in used}),
        "seconds": seconds,
        "num_bad_rows": len(errors.messages),
        "bad_rows": errors.messages,
        "scores": [score.summary(rng) for score in (full, *live)],
        "most_confused": most_confused(confusion),
        "confusions": confusion.tolist(),
        "cpu_per_audio_second": (cost := cpu_by_stage(model, read_audio(used[0].path))),
        "sessions_a_core": sessions_a_core(model, read_audio(used[0].path), cost),
    }


def _truth(model: AcousticModel, utterance: Utterance, samples: NDArray[np.float32]) -> list[Phone]:
    units = iter(UNITS[unit] for unit in utterance.units)
    syllables = [tuple(next(units) for _ in range(length)) for length in utterance.syllables]
    return spoken(align_units(model, samples, SAMPLE_RATE_HZ, syllables))


def _scored(
    model: AcousticModel, samples: NDArray[np.float32]
) -> list[tuple[float, list[ScoreEvent]]]:
    """Scores as they come with the sound: the media time heard by then, and what is new."""
    scores = SpeechScores(model, SAMPLE_RATE_HZ)
    scored = []
    for start in range(0, len(samples), _CHUNK_SAMPLES):
        chunk = samples[start : start + _CHUNK_SAMPLES]
        (events,) = listen(model, [scores.hear(chunk)])
        scored.append(((start + len(chunk)) / SAMPLE_RATE_HZ, events))
    (rest,) = listen(model, [scores.finish()])
    return [*scored, (len(samples) / SAMPLE_RATE_HZ, rest)]


def _live(
    model: AcousticModel, scored: Sequence[tuple[float, list[ScoreEvent]]], rule: tuple[int, float]
) -> tuple[list[Phone], list[float], list[Phone]]:
    """Units as they were first said, the media time heard by then, and the units once final."""
    agreement, confidence = rule
    recognizer = Recognizer(
        model, sample_rate_hz=SAMPLE_RATE_HZ, agreement=agreement, least_confidence=confidence
    )
    first: list[Phone] = []
    said_s: list[float] = []
    finals: list[Phone] = []
    known: set[int] = set()
    for heard_s, scores in scored:
        events = recognizer.follow(scores)
        finals += spoken(once_final(events))
        new = spoken(first_said(events, known))
        first += new
        said_s += [heard_s] * len(new)
    return first, said_s, finals


def is_put_out(said: Phone, after: Phone | SpeechChange | None) -> bool:
    """Tell whether the output rule has put out a unit, by what was said next.

    What the rule puts out comes after the revisions of all units before it.
    """
    return not said.final and not (isinstance(after, Phone) and after.index > said.index)


def first_said(events: Sequence[Phone | SpeechChange], known: set[int]) -> list[Phone]:
    """Pick what the output rule put out and what it passed over, which is said along with that.

    Parameters
    ----------
    events
        What a live recognizer said, in order.
    known
        Indices of units said before; those of ``events`` are added.
    """
    first = []
    for event, after in zip_longest(events, events[1:]):
        if isinstance(event, Phone):
            if event.index not in known or is_put_out(event, after):
                first.append(event)
            known.add(event.index)
    return first


def once_final(events: Iterable[Phone | SpeechChange]) -> list[Phone]:
    """Pick the units that will not change any more from what a live recognizer said."""
    return [event for event in events if isinstance(event, Phone) and event.final]


def _units(phones: Iterable[Phone]) -> list[str]:
    return [phone.unit for phone in phones]


def _shapes(phones: Iterable[Phone]) -> list[str]:
    return mouth_shapes(_units(phones))


def _count(
    by_speaker: dict[str, ErrorCounts], speaker: str, said: Sequence[str], heard: Sequence[str]
) -> None:
    before = by_speaker.get(speaker, ErrorCounts())
    by_speaker[speaker] = before + count_errors(said, heard)


def _delays(truth: Sequence[Phone], heard: Sequence[Phone], said_s: Sequence[float]) -> list[float]:
    """Delays of the units that were heard right."""
    pairs = matched_pairs([phone.unit for phone in truth], [phone.unit for phone in heard])
    return [
        said_s[j] - truth[i].onset_s
        for i, j in pairs
        if i is not None and j is not None and truth[i].unit == heard[j].unit
    ]


def _confuse(confusion: NDArray[np.int64], truth: Sequence[Phone], heard: Sequence[Phone]) -> None:
    """Count pairs; the silence row holds insertions, its column deletions."""
    for i, j in matched_pairs([phone.unit for phone in truth], [phone.unit for phone in heard]):
        row = SILENCE if i is None else truth[i].unit
        column = SILENCE if j is None else heard[j].unit
        confusion[UNIT_INDEX[row], UNIT_INDEX[column]] += 1


def most_confused(confusion: NDArray[np.int64], count: int = 15) -> list[dict[str, object]]:
    """Return the commonest confusions; ``sil`` as the said unit means an insertion."""
    wrong = confusion.copy()
    np.fill_diagonal(wrong, 0)
    order = np.argsort(wrong, axis=None)[::-1][:count]
    return [
        {"said": UNITS[row], "heard": UNITS[column], "times": int(wrong[row, column])}
        for row, column in zip(*np.unravel_index(order, wrong.shape), strict=True)
    ]


def cpu_by_stage(model: AcousticModel, samples: NDArray[np.float32]) -> dict[str, float]:
    """CPU seconds per second of sound of each stage, fed 10 ms at a time."""
    chunks = [samples[at : at + _CHUNK_SAMPLES] for at in range(0, len(samples), _CHUNK_SAMPLES)]
    blocks = [
        samples[at : at + BLOCK_SAMPLES]
        for at in range(0, len(samples) - BLOCK_SAMPLES + 1, BLOCK_SAMPLES)
    ]
    front_end, stream, decoder = model.front_end(), model.stream(), Decoder(model.topology)
    detector, resampler = VoiceActivityDetector(), Resampler(48_000)
    at_48_khz = np.repeat(samples, 3)
    frames = model.front_end().accept_waveform(samples)
    scores = model.stream().accept(frames)  # compiled before the clock starts
    decoder.accept(scores[0])
    decoder.reset()

    def run(
        stage: Callable[[NDArray[np.float32]], object], pieces: Iterable[NDArray[np.float32]]
    ) -> float:
        begin = time.process_time()
        for piece in pieces:
            stage(piece)
        return (time.process_time() - begin) * SAMPLE_RATE_HZ / len(samples)

    return {
        "resampler_from_48_khz": run(
            resampler.accept_waveform, np.array_split(at_48_khz, len(chunks))
        ),
        "voice_activity": run(detector.accept_block, blocks),
        "front_end": run(front_end.accept_waveform, chunks),
        "acoustic_model": run(stream.accept, np.split(frames, len(frames))),
        "decoder": run(decoder.accept, scores),
    }


def sessions_a_core(
    model: AcousticModel, samples: NDArray[np.float32], cost: dict[str, float]
) -> float:
    """Sessions that one core can hear when 16 of them are scored together, fed 10 ms at a time.

    ``cost`` is what :func:`cpu_by_stage` measured for one; the resampler, which sound at 16 kHz
    does not need, is left out.
    """
    frames = model.front_end().accept_waveform(samples)
    streams = [model.stream() for _ in range(_SESSIONS_TOGETHER)]
    begin = time.process_time()
    for frame in range(len(frames)):
        model.score([(stream, frames[frame : frame + 1]) for stream in streams])
    together = (time.process_time() - begin) * SAMPLE_RATE_HZ / len(samples) / _SESSIONS_TOGETHER
    own = ("voice_activity", "front_end", "decoder")
    return 1 / (together + sum(cost[stage] for stage in own))
