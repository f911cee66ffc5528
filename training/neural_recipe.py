"""From corpora to the neural recognizer: alignment, teacher, training, search, model card.

The network begins with the weights of Whisper's encoder, or with those of a model made here, and
learns the states of a forced alignment. The alignment is that of the model it begins with, or
another model's until half of the steps and then the network's own: of an output that hears 30 ms
ahead, because a unit's beginning is plainer with what follows.

With Whisper there is a teacher too (:mod:`training.teacher`), which hears whole recordings and has
learnt the first alignment: half of a frame's share is then what the teacher says, and in recordings
without text all of it.

The recognizer says units early and corrects them: the scale of the scores and the unit penalty are
those with the fewest errors on dev, as first said and in the full traceback together.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from evaluation.recognizer import ErrorCounts, count_errors, first_said
from services.recognizer.acoustic_model import AcousticModel, Topology
from services.recognizer.features import HOP_S, SAMPLE_RATE_HZ
from services.recognizer.load import load_model
from services.recognizer.neural import NeuralModel
from services.recognizer.pipeline import Recognizer, VoiceBegins, VoiceEnds
from services.recognizer.unit_language import UnitLanguage
from shared.errors import UserError
from shared.phones import UNITS
from training.align import spoken
from training.corpus import RowErrors, is_synthetic
from training.durations import AlignedUnit, UnitDurations
from training.examples import WORD_UNITS, Example, load_examples, load_untranscribed
from training.gmm import units_of_path, utterance_graph, viterbi_path
from training.network import Network, Shape
from training.network_export import network_of, onnx_of
from training.network_training import BATCH_S, Recording, Targets, Trainer, log_shares_of
from training.recipes import (
    UNCHOSEN,
    Report,
    all_scores,
    choose_search,
    error_rate,
    with_penalty,
    write_card,
)
from training.teacher import (
    NUM_LAYERS,
    Teacher,
    WholeEncoder,
    all_heard,
    train_teacher,
    with_progress,
)
from training.unit_language import language_of_corpora, load_language
from training.whisper_weights import load_whisper

STATES_PER_UNIT = 3
NUM_STATES = STATES_PER_UNIT * len(UNITS)
LOOK_AHEADS_MS = (10, 30, 60, 100, 200)  # of the output layers
LOOK_AHEAD_MS = 10  # of the main one: 35 ms after its onset a unit may be known
NUM_STEPS = 800
_FRAME_MS = 1000 * HOP_S
_LONGEST_LOOK_AHEAD = 100  # feature frames
_SHARES = {"sentence": 0.33, "word": 0.08, "synthetic": 0.30}  # of the frames heard
_UNTRANSCRIBED_SHARE = 0.29  # likewise
_LESSONS = 1000  # recordings of a kind that the teacher learns
_ALIGNING_FRAMES = 3  # look-ahead of the output that aligns; longer ones are learnt later
_ALIGNED_ANEW_AT = 0.5  # of the steps: from there on another model's alignment counts no more
_JUDGED_EVERY = 0.1  # of the steps: dev is recognised
_SCALE = 0.5  # of the log scores, until it is chosen
_UNIT_PENALTY = 1.0  # likewise
_LANGUAGE_SCALE = 2.0  # of the language's log shares; chosen on development data
_PRIOR_SCALE = 0.5  # of the states' log shares; chosen on development data
_SCALES = (0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
_LEAST_STAY, _MOST_STAY = 0.05, 0.98
_SMOOTHED = 20  # steps, in the curves


@dataclass(frozen=True, slots=True)
class _Aligned:
    """An utterance with its states."""

    number: int  # of the example
    example: Example
    states: NDArray[np.int64]  # (frames,)
    units: list[AlignedUnit]


@dataclass(frozen=True, slots=True)
class _Statistics:
    """What an alignment says beside the network."""

    topology: Topology
    log_prior: NDArray[np.float32]  # (states,)


@dataclass(frozen=True, slots=True)
class _Taught:
    """What the teacher says; without one there is nothing."""

    examples: list[Targets] = field(default_factory=list)  # of every example
    untranscribed: list[Recording] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class _Course:
    """Follows the training: aligns anew in its course, and recognises dev now and then."""

    trainer: Trainer
    examples: Sequence[Example]
    dev: Sequence[Example]
    taught: _Taught
    language: UnitLanguage
    statistics: _Statistics
    num_steps: int
    aligned_anew_at: int | None  # step
    report: Report
    losses: list[tuple[int, float]] = field(default_factory=list)
    rates: list[tuple[int, float]] = field(default_factory=list)

    def watch(self, step: int, loss: float) -> None:
        """Take note of a step."""
        self.losses.append((step, loss))
        if step == self.aligned_anew_at:
            self._align_anew()
            self.report(f"step {step}: aligned anew")
        if step % max(1, round(_JUDGED_EVERY * self.num_steps)) == 0:
            line = f"step {step}: {loss:.3f} nats a frame"
            if self.dev:
                self.rates.append((step, self._dev_error_rate()))
                line += f", dev phone error {100 * self.rates[-1][1]:.1f} %"
            self.report(line)

    def _align_anew(self) -> None:
        network = self.trainer.mean
        output = _aligning_output(network.shape.look_aheads)
        scores = _scores_of(network, output, self.statistics, self.examples)
        aligned = _aligned(scores, self.statistics.topology, self.examples, self.report)
        self.trainer.replace_recordings(_recordings(aligned, self.taught))
        self.statistics = _statistics(aligned, self.language)

    def _dev_error_rate(self) -> float:
        output = self.trainer.main_output
        scores = _scores_of(self.trainer.mean, output, self.statistics, self.dev)
        scaled = [np.float32(_SCALE) * rows for rows in scores]
        return error_rate(with_penalty(self.statistics.topology, _UNIT_PENALTY), scaled, self.dev)


def train_neural(
    corpora: Sequence[Path],
    output: Path,
    *,
    aligner: Path | None = None,
    whisper: Path | None = None,
    start: Path | None = None,
    untranscribed: Sequence[Path] = (),
    language: Path | None = None,
    look_ahead_ms: float = LOOK_AHEAD_MS,
    seed: int = 0,
    num_steps: int = NUM_STEPS,
    num_threads: int | None = None,
    shipping: bool = True,
    report: Report = print,
) -> None:
    """Train the neural recognizer and write the model, its card and its training curves.

    Parameters
    ----------
    corpora
        Folders that :func:`training.corpus.read_corpus` reads; splits ``train`` and ``dev``.
    output
        The ``.npz`` file to write; the card is written beside it as ``.md``, the curves as
        ``.png``.
    aligner
        A model that aligns until the network does, such as :func:`training.recipes.train_gmm`
        writes. None leaves it to ``start``.
    whisper
        Folder with Whisper base, see :func:`training.whisper_weights.load_whisper`: the teacher.
        Without it the states of the alignment alone are learnt.
    start
        A model that this function has written, whose network learns further, such as to know one's
        own speakers. Without it the network begins with Whisper's weights.
    untranscribed
        Folders of recordings in any language, which the teacher labels. Nobody knows their
        licences: name only what may be used.
    language
        What :func:`training.unit_language.train_language` has written; else the language is that
        of the corpora.
    look_ahead_ms
        Of the output layer that counts most and is in use, in whole frames of 10 ms.
    seed
        Of new weights, order and changes of the sound. The same seed and the same number of
        threads give the same model on the same kind of processor.
    num_steps
        Batches of 30 s of sound.
    num_threads
        That compute; None takes all cores.
    shipping
        Leave out rows whose licence forbids giving the model away.
    report
        Receives lines of progress.

    Raises
    ------
    UserError
        If there is nothing to train on, nothing to begin with, nothing that aligns, no teacher for
        recordings without text, or a file cannot be read.
    """
    if untranscribed and whisper is None:
        raise UserError("only a teacher can label what --untranscribed names: give --whisper too")
    torch.set_num_threads(num_threads or os.cpu_count() or 1)
    torch.manual_seed(seed)
    before = load_model(start) if start else None
    first = load_model(aligner) if aligner else before
    if first is None:
        raise UserError("nothing aligns the recordings: give --aligner or --start-from")
    network = _begun(whisper, before, _look_aheads(look_ahead_ms))
    encoder = _whole_encoder(whisper) if whisper else None
    errors = RowErrors()
    examples = load_examples(corpora, errors, shipping=shipping, with_samples=True)
    sounds = load_untranscribed(untranscribed, errors) if untranscribed else []
    known = load_language(language) if language else language_of_corpora(examples)
    aligned = _aligned(_first_scores(first, examples), first.topology, examples, report)
    report(f"{len(aligned)} of them fit their text")
    taught = _Taught()
    if encoder:
        lessons = _recordings(_lessons(aligned, seed), taught)
        teacher = train_teacher(encoder, lessons, seed=seed, report=report)
        taught = _taught(teacher, examples, sounds, report)
    trainer = Trainer(
        network,
        _recordings(aligned, taught),
        main_output=network.shape.look_aheads.index(round(look_ahead_ms / _FRAME_MS)),
        seed=seed,
    )
    course = _Course(
        trainer=trainer,
        examples=examples,
        dev=_dev_examples(corpora, shipping=shipping),
        taught=taught,
        language=known,
        statistics=_statistics(aligned, known),
        num_steps=num_steps,
        aligned_anew_at=round(_ALIGNED_ANEW_AT * num_steps) if aligner else None,
        report=report,
    )
    trainer.train(num_steps, course.watch)
    unscaled = _model(trainer, course.statistics)

    def rate(
        topology: Topology, scores: Sequence[NDArray[np.float32]], examples: Sequence[Example]
    ) -> float:
        first = first_said_error_rate(replace(unscaled, topology=topology), scores, examples)
        return (error_rate(topology, scores, examples) + first) / 2

    choice = choose_search(
        unscaled,
        corpora,
        scales=_SCALES,
        shipping=shipping,
        with_samples=True,
        rate=rate,
        report=report,
    )
    scale, penalty = (choice.scale, choice.unit_penalty) if choice else (_SCALE, _UNIT_PENALTY)
    replace(unscaled, topology=with_penalty(unscaled.topology, penalty), kappa=scale).save(output)
    draw_curves(course.losses, course.rates, output.with_suffix(".png"))
    begun = f"`{start.name}`" if start else "Whisper's weights (Radford et al. 2023, MIT licence)"
    write_card(
        output,
        title=f"Neural recognizer, a causal transformer of {network.shape.layers} layers",
        details=f"begun with {begun}, seed {seed}, {num_steps} steps of {BATCH_S} s of sound, "
        f"aligned {f'first by `{aligner.name}`' if aligner else 'by the same'}"
        + _words_about(taught),
        examples=examples,
        errors=errors,
        choice=choice or UNCHOSEN,
        measure="mean of the phone error rates of the full traceback and as first said",
    )
    errors.tell(report)


def first_said_error_rate(
    model: AcousticModel, scores: Sequence[NDArray[np.float32]], examples: Sequence[Example]
) -> float:
    """Phone error rate of what is first said live, from the examples' scaled scores."""
    total = ErrorCounts()
    for rows, example in zip(scores, examples, strict=True):
        recognizer = Recognizer(model, sample_rate_hz=SAMPLE_RATE_HZ)
        live = recognizer.follow([VoiceBegins(0), rows, VoiceEnds(len(rows))])
        said = [phone.unit for phone in spoken(first_said(live, set()))]
        total += count_errors([UNITS[unit] for unit in example.units], said)
    return total.rate


def _begun(
    whisper: Path | None, before: AcousticModel | None, look_aheads: tuple[int, ...]
) -> Network:
    """Make the network that learns, of Whisper's or of a model's that learnt before."""
    if before is None:
        if whisper is None:
            raise UserError(
                "training begins with Whisper's weights or with a model made here: give --whisper, "
                "--start-from or both"
            )
        network = Network(Shape(num_states=NUM_STATES, look_aheads=look_aheads))
        load_whisper(network, whisper)
        return network
    if isinstance(before, NeuralModel) and tuple(before.look_aheads.tolist()) == look_aheads:
        with suppress(KeyError):  # another network that runs in the same way
            return network_of(before.network, look_aheads)
    asked = ", ".join(f"{frames * _FRAME_MS:g}" for frames in look_aheads)
    raise UserError(
        f"the model of --start-from was not written by this command with the look-aheads {asked} "
        "ms; begin with one that was"
    )


def _whole_encoder(whisper: Path) -> WholeEncoder:
    shape = Shape(num_states=NUM_STATES, look_aheads=(), layers=NUM_LAYERS)
    encoder = WholeEncoder(shape)
    load_whisper(encoder, whisper)
    return encoder


def _look_aheads(main_ms: float) -> tuple[int, ...]:
    """Look-aheads of all output layers, feature frames."""
    main = main_ms / _FRAME_MS
    if not (1 <= main <= _LONGEST_LOOK_AHEAD and main == round(main)):
        raise UserError(
            f"a look-ahead of {main_ms:g} ms cannot be trained; give 10, 20, 30... up to "
            f"{_LONGEST_LOOK_AHEAD * _FRAME_MS:g}"
        )
    others = [round(ms / _FRAME_MS) for ms in LOOK_AHEADS_MS]
    return tuple(sorted({*others, round(main)}))


def _first_scores(
    aligner: AcousticModel, examples: Sequence[Example]
) -> Iterator[NDArray[np.float32]]:
    """Scores of another model; a network's whole recordings at once where that can be."""
    if not isinstance(aligner, NeuralModel):
        return all_scores(aligner, examples)
    output = _aligning_output(aligner.look_aheads.tolist())
    with suppress(KeyError):
        network = network_of(aligner.network, aligner.look_aheads.tolist())
        statistics = _Statistics(aligner.topology, aligner.log_prior)
        return _scores_of(network, output, statistics, examples)
    return all_scores(replace(aligner, head=output, kappa=1.0), examples)


def _aligning_output(look_aheads: Sequence[int]) -> int:
    """Output layer that is best for alignment."""
    return int(np.abs(np.array(look_aheads) - _ALIGNING_FRAMES).argmin())


def _scores_of(
    network: Network, output: int, statistics: _Statistics, examples: Sequence[Example]
) -> Iterator[NDArray[np.float32]]:
    """Scores of all frames of every recording, shape (frames, states) each."""
    for example in examples:
        yield log_shares_of(network, output, _samples(example)) - statistics.log_prior


def _samples(example: Example) -> NDArray[np.int16]:
    if example.samples is None:
        raise ValueError("an example has no samples")
    return example.samples


def _aligned(
    scores: Iterable[NDArray[np.float32]],
    topology: Topology,
    examples: Sequence[Example],
    report: Report,
) -> list[_Aligned]:
    """Find the states of all frames, ``STATES_PER_UNIT`` for each unit; drop what does not fit."""
    aligned = []
    own = np.diff(topology.first_state)
    of_state = np.repeat(np.arange(len(UNITS)), own)
    place = np.arange(len(of_state)) - topology.first_state[of_state]
    # middle of the n-th part of a unit, in parts of another size
    part = (2 * place + 1) * STATES_PER_UNIT // (2 * own[of_state])
    followed = with_progress(examples, "aligned", report)
    for number, (rows, example) in enumerate(zip(scores, followed, strict=True)):
        graph = utterance_graph(example.units, example.syllables, topology.first_state)
        path, _ = viterbi_path(rows[:, graph.states], graph, topology.log_stay, topology.log_leave)
        if len(path):
            states = graph.units[graph.unit_of[path]] * STATES_PER_UNIT + part[graph.states[path]]
            aligned.append(_Aligned(number, example, states, units_of_path(path, graph)))
    if not aligned:
        raise UserError("no recording fits its text; is the aligner trained?")
    return aligned


def _lessons(aligned: Sequence[_Aligned], seed: int) -> list[_Aligned]:
    """Draw what the teacher learns."""
    rng = np.random.default_rng(seed)
    drawn = []
    for kind in _SHARES:
        of_kind = [one for one in aligned if _kind(one.example) == kind]
        drawn += [of_kind[place] for place in rng.permutation(len(of_kind))[:_LESSONS]]
    return drawn


def _taught(
    teacher: Teacher,
    examples: Sequence[Example],
    sounds: Sequence[NDArray[np.int16]],
    report: Report,
) -> _Taught:
    """Let the teacher hear everything once."""
    recordings = [*map(_samples, examples), *sounds]
    said = all_heard(teacher.targets_of, recordings, "labelled by the teacher", report)
    without_text = said[len(examples) :]
    num_frames = sum(map(len, without_text))
    return _Taught(
        said[: len(examples)],
        [
            Recording(samples=samples, targets=targets, weight=_UNTRANSCRIBED_SHARE / num_frames)
            for samples, targets in zip(sounds, without_text, strict=True)
        ],
    )


def _words_about(taught: _Taught) -> str:
    """Say on the card who taught, and how much without text."""
    if not taught.examples:
        return ""
    words = ", taught by a readout of Whisper's whole encoder"
    if taught.untranscribed:
        minutes = sum(len(recording.targets) for recording in taught.untranscribed) * HOP_S / 60
        words += f", also on {minutes:.1f} minutes without text"
    return words


def _recordings(aligned: Sequence[_Aligned], taught: _Taught) -> list[Recording]:
    """Weigh what the network hears."""
    recordings = []
    for one, weight in zip(aligned, _weights(aligned), strict=True):
        targets = Targets.hard(one.states)
        if taught.examples:
            targets = targets.halved_with(taught.examples[one.number])
        samples = _samples(one.example)
        recordings.append(Recording(samples=samples, targets=targets, weight=weight))
    return recordings + taught.untranscribed


def _weights(aligned: Sequence[_Aligned]) -> list[float]:
    """Each kind of speech has its share, rare speakers count more."""
    kinds = [_kind(one.example) for one in aligned]
    frames = dict.fromkeys(_SHARES, 0.0)
    for kind, one in zip(kinds, aligned, strict=True):
        frames[kind] += one.example.weight * len(one.states)
    return [
        _SHARES[kind] * one.example.weight / frames[kind]
        for kind, one in zip(kinds, aligned, strict=True)
    ]


def _kind(example: Example) -> str:
    if is_synthetic(example.licence):
        return "synthetic"
    return "sentence" if len(example.units) > WORD_UNITS else "word"


def _statistics(aligned: Sequence[_Aligned], language: UnitLanguage) -> _Statistics:
    """Count states, transitions and durations."""
    counts = np.ones(NUM_STATES)
    occupied, left = np.full(NUM_STATES, 2.0), np.ones(NUM_STATES)
    durations = UnitDurations()
    for one, weight in zip(aligned, _weights(aligned), strict=True):
        of_states = np.bincount(one.states, minlength=NUM_STATES)
        counts += weight * len(aligned) * of_states
        occupied += of_states
        ends = np.append(np.flatnonzero(np.diff(one.states)), len(one.states) - 1)
        np.add.at(left, one.states[ends], 1.0)
        durations.add(one.units, one.example.weight)
    stay = np.clip(1 - left / occupied, _LEAST_STAY, _MOST_STAY)
    mean_s, spread_s = durations.mean_and_spread_s()
    topology = Topology(
        first_state=np.arange(len(UNITS) + 1) * STATES_PER_UNIT,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        language=language,
        language_scale=_LANGUAGE_SCALE,
        duration_mean_s=mean_s,
        duration_spread_s=spread_s,
    )
    log_prior = _PRIOR_SCALE * np.log(counts / counts.sum())
    return _Statistics(topology, log_prior.astype(np.float32))


def _model(trainer: Trainer, statistics: _Statistics) -> NeuralModel:
    """Make the recognizer's model of the running mean of the weights; its scale is 1."""
    return NeuralModel(
        topology=statistics.topology,
        network=onnx_of(trainer.mean),
        look_aheads=np.array(trainer.network.shape.look_aheads),
        log_prior=statistics.log_prior,
        kappa=1.0,
        head=trainer.main_output,
    )


def _dev_examples(corpora: Sequence[Path], *, shipping: bool) -> list[Example]:
    try:
        return load_examples(
            corpora, RowErrors(), split="dev", shipping=shipping, with_samples=True
        )
    except UserError:
        return []


def draw_curves(
    losses: Sequence[tuple[int, float]], rates: Sequence[tuple[int, float]], path: Path
) -> None:
    """Draw cross-entropy and dev phone error over the steps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 (slow to load)
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(6, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    left = figure.add_subplot()
    right = left.twinx()
    steps, nats = np.array(losses).T
    width = min(_SMOOTHED, len(steps))
    left.plot(steps[width - 1 :], np.convolve(nats, np.ones(width) / width, "valid"), linewidth=0.8)
    if rates:
        right.plot(*zip(*((step, 100 * rate) for step, rate in rates), strict=True), "o:")
    left.set_xlabel("steps")
    left.set_ylabel("nats a frame (line)")
    right.set_ylabel("dev phone error % (dots)")
    right.set_ylim(bottom=0)
    figure.savefig(path, dpi=90)
