"""From corpora to a model file with its card: the Gaussian mixture recognizer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evaluation.recognizer import ErrorCounts, count_errors
from services.recognizer.acoustic_model import AcousticModel, Topology
from services.recognizer.decoder import Decoder
from services.recognizer.features import NUM_FEATURES, cepstra_of_all
from services.recognizer.gmm import GmmModel
from services.recognizer.voice_warp import without_pitch
from shared.errors import UserError
from shared.phones import SILENCE, UNITS
from training import SYNTHETIC_WEIGHT
from training.augmentation import Augmentation
from training.corpus import RowErrors, is_synthetic
from training.examples import Example, load_examples
from training.feature_cache import as_floats
from training.gmm import (
    FrameSet,
    decorrelate,
    estimate,
    first_estimate,
    split,
    topology_of,
)
from training.unit_language import language_of_corpora, load_language

Report = Callable[[str], None]
Rate = Callable[[Topology, Sequence[NDArray[np.float32]], Sequence[Example]], float]

_STATES_PER_UNIT = 5  # Li et al. 2011, section 3.1
_HALF_WIDTH = 2  # of the differences: the textbook's
_FLAT_STEP = 4  # one recording in so many makes the first alignment
_ROTATED_AT = 8  # mixtures per state when the features are decorrelated
_SENTENCE_SYLLABLES = 4  # real recordings of so many count as connected speech
_SENTENCE_COPIES = 3
_WORD_WEIGHT = 0.3  # of isolated words and syllables
_SCORED_TOGETHER = 16  # recordings
_SELDOM = 0.5  # recordings of less weight are thinned out
_SCALES = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)  # of the log scores of a model alone
_UNIT_PENALTIES = (2.0, 1.5, 1.0, 0.5, 0.0, -0.5, -1.0, -2.0)


@dataclass(frozen=True, slots=True)
class Choice:
    """What was chosen on development data."""

    scale: float  # of the log scores
    unit_penalty: float
    error_rate: float


UNCHOSEN = Choice(0.2, -1.0, 1.0)


def train_gmm(
    corpora: Sequence[Path],
    output: Path,
    *,
    seed: int = 0,
    language: Path | None = None,
    num_mixtures: int = 32,
    synthetic_weight: float = SYNTHETIC_WEIGHT,
    shipping: bool = True,
    report: Report = print,
) -> None:
    """Train the Gaussian mixture recognizer and write the model and its card.

    Parameters
    ----------
    corpora
        Folders that :func:`training.corpus.read_corpus` reads; splits ``train`` and ``dev``.
    output
        The ``.npz`` file to write; the card is written beside it as ``.md``.
    seed
        Of the augmentation.
    language
        What :func:`training.unit_language.train_language` has written; else the language is that
        of the corpora.
    num_mixtures
        Gaussians per state, a power of two.
    synthetic_weight
        Weight of synthetic speech against real speech.
    shipping
        Leave out rows whose licence forbids giving the model away.
    report
        Receives lines of progress.

    Raises
    ------
    UserError
        If there is nothing to train on, or the number of mixtures is no power of two.
    """
    if num_mixtures < 1 or num_mixtures & (num_mixtures - 1):
        raise UserError(f"{num_mixtures} mixtures are no power of two; give 1, 2, 4, 8, 16...")
    errors = RowErrors()
    heard = load_examples(corpora, errors, shipping=shipping, synthetic_weight=synthetic_weight)
    rng = np.random.default_rng(seed)
    examples = [copy for example in heard for copy in _copies(example, rng)]
    first_state = np.arange(len(UNITS) + 1) * _STATES_PER_UNIT
    prior_mean = _mean_cepstra(heard)
    report(f"{len(heard)} recordings, {len(examples)} with their changed copies")
    some = FrameSet.build(examples[::_FLAT_STEP], first_state, prior_mean, _HALF_WIDTH)
    hmm = first_estimate(some, first_state)
    for _ in range(4):
        report(f"flat start: log likelihood {some.realign(hmm):.3f} per frame")
        hmm = estimate(some, hmm)
    frames = FrameSet.build(examples, first_state, prior_mean, _HALF_WIDTH)
    rotation = np.eye(NUM_FEATURES, dtype=np.float32)
    report(f"1 mixture: log likelihood {frames.realign(hmm):.3f} per frame")
    hmm = estimate(frames, hmm, 3)
    size = 1
    while size < num_mixtures:
        size *= 2
        hmm = estimate(frames, split(hmm, frames, size), 5)
        if size == min(_ROTATED_AT, num_mixtures):
            hmm, rotation = decorrelate(frames, hmm)
            hmm = estimate(frames, hmm, 3)
            report(f"{size} mixtures: log likelihood {frames.realign(hmm):.3f} per frame")
            hmm = estimate(frames, hmm, 3)
    known = load_language(language) if language else language_of_corpora(heard)
    model = GmmModel(
        topology=topology_of(hmm, known, frames),
        mixtures=hmm.mixtures,
        rotation=rotation,
        prior_mean=prior_mean,
        half_width=_HALF_WIDTH,
    )
    choice = choose_search(model, corpora, shipping=shipping, report=report) or UNCHOSEN
    topology = with_penalty(model.topology, choice.unit_penalty)
    replace(model, topology=topology, kappa=choice.scale).save(output)
    write_card(
        output,
        title=f"Gaussian mixture recognizer, {num_mixtures} mixtures in each of "
        f"{len(UNITS)} x {_STATES_PER_UNIT} states",
        details=f"seed {seed}, synthetic weight {synthetic_weight:.2f}",
        examples=heard,
        errors=errors,
        choice=choice,
    )
    errors.tell(report)


def error_rate(
    topology: Topology, scores: Sequence[NDArray[np.float32]], examples: Sequence[Example]
) -> float:
    """Phone error rate of the full traceback, from the examples' scores, (frames, states) each."""
    decoder = Decoder(topology)
    total = ErrorCounts()
    for rows, example in zip(scores, examples, strict=True):
        decoder.reset()
        for row in rows:
            decoder.accept(row)
        units = [UNITS[segment.unit] for segment in decoder.finish()]
        heard = [unit for unit in units if unit != SILENCE]
        total += count_errors([UNITS[unit] for unit in example.units], heard)
    return total.rate


def choose_search(
    model: AcousticModel,
    corpora: Sequence[Path],
    *,
    scales: Sequence[float] = _SCALES,
    shipping: bool = True,
    with_samples: bool = False,
    rate: Rate = error_rate,
    report: Report = print,
) -> Choice | None:
    """Choose scale and unit penalty on the split ``dev``, if there is one.

    Parameters
    ----------
    model
        A model whose own scale is 1.
    scales
        Scales of its log scores to try.
    corpora, shipping, report
        As for :func:`train_gmm`.
    with_samples
        Let the model hear the recordings through its own front end.
    rate
        What is to be least, of the scaled scores of all recordings.
    """
    try:
        dev = load_examples(
            corpora, RowErrors(), split="dev", shipping=shipping, with_samples=with_samples
        )
    except UserError:
        report("no dev recordings: scale and unit penalty are not chosen")
        return None
    scores = list(all_scores(model, dev))
    best: Choice | None = None
    for scale in scales:
        scaled = [np.float32(scale) * rows for rows in scores]
        for unit_penalty in _UNIT_PENALTIES:
            found = rate(with_penalty(model.topology, unit_penalty), scaled, dev)
            if best is None or found < best.error_rate:
                best = Choice(scale, unit_penalty, found)
                report(
                    f"{100 * found:.1f} % errors on dev with scale {scale} and unit penalty "
                    f"{unit_penalty}"
                )
    return best


def with_penalty(topology: Topology, unit_penalty: float) -> Topology:
    """Let every unit cost or earn something."""
    return replace(topology, unit_penalty=unit_penalty)


def all_scores(model: AcousticModel, examples: Sequence[Example]) -> Iterator[NDArray[np.float32]]:
    """Scores of all frames of unchanged recordings, shape (frames, states) each.

    The model hears the samples through its own front end; without samples it is given the log-mel
    features.
    """
    for start in range(0, len(examples), _SCORED_TOGETHER):
        some = examples[start : start + _SCORED_TOGETHER]
        streams = [model.stream() for _ in some]
        heard = [_frames_for(model, example) for example in some]
        begun = model.score(list(zip(streams, heard, strict=True)))
        ended = model.score([(stream, None) for stream in streams])
        for pair in zip(begun, ended, strict=True):
            yield np.concatenate(pair)


def _frames_for(model: AcousticModel, example: Example) -> NDArray[np.float32]:
    if example.samples is None:
        return without_pitch(example.log_mel.astype(np.float32))
    return model.front_end().accept_waveform(as_floats(example.samples))


def _copies(example: Example, rng: np.random.Generator) -> list[Example]:
    """Give real sentences changed copies, each in full; words and syllables said alone count less.

    Half of the recordings that come once are changed. What counts little comes seldom instead.
    """
    num_copies, weight = 1, example.weight
    if not is_synthetic(example.licence):
        if len(example.syllables) >= _SENTENCE_SYLLABLES:
            num_copies = _SENTENCE_COPIES
        else:
            weight *= _WORD_WEIGHT
    if weight < _SELDOM:
        num_copies = int(rng.random() < weight / _SELDOM)
        weight = _SELDOM
    copies = []
    for number in range(num_copies):
        changed = number > 0 or rng.random() < 0.5
        augmentation = Augmentation.draw(rng) if changed else None
        copies.append(replace(example, weight=weight, augmentation=augmentation))
    return copies


def _mean_cepstra(examples: Sequence[Example]) -> NDArray[np.float32]:
    step = max(1, len(examples) // 500)
    means = [
        cepstra_of_all(example.log_mel.astype(np.float32)).mean(axis=0)
        for example in examples[::step]
    ]
    mean: NDArray[np.float32] = np.mean(means, axis=0, dtype=np.float32)
    return mean


def write_card(
    output: Path,
    *,
    title: str,
    details: str,
    examples: Sequence[Example],
    errors: RowErrors,
    choice: Choice,
    measure: str = "phone error rate",
) -> None:
    """Write what the model was made of, beside the model; ``measure`` is what was chosen by."""
    licences: dict[str, list[Example]] = {}
    for example in examples:
        licences.setdefault(example.licence or "none given", []).append(example)
    rows = [
        f"| {licence} | {len(group)} | {len({example.speaker for example in group})} | "
        f"{sum(len(example.log_mel) for example in group) / 6000:.1f} |"
        for licence, group in sorted(licences.items())
    ]
    lines = [
        f"# {title}",
        "",
        f"Made by `training.recipes`, {details}.",
        "",
        "| licence of the recordings | recordings | speakers | minutes without outer silence |",
        "|---|---|---|---|",
        *rows,
        "",
        f"{len(errors.messages)} rows were skipped.",
    ]
    if choice is not UNCHOSEN:
        lines += [
            "",
            f"Chosen on dev: scale of the log scores {choice.scale}, unit penalty "
            f"{choice.unit_penalty}; {measure} there {100 * choice.error_rate:.1f} %.",
        ]
    output.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
