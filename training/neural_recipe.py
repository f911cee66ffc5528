"""From corpora to the neural recognizer: alignment, training, realignment, search, model card."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from services.recognizer.acoustic_model import AcousticModel, Topology
from services.recognizer.features import HOP_S
from services.recognizer.load import load_model
from services.recognizer.neural import NeuralModel
from services.recognizer.unit_language import UnitLanguage
from shared.errors import UserError
from shared.phones import UNITS
from training.corpus import RowErrors, is_synthetic
from training.durations import AlignedUnit, UnitDurations
from training.examples import WORD_UNITS, Example, load_examples
from training.gmm import SIL, units_of_path, utterance_graph, viterbi_path
from training.network import Network, Shape
from training.network_export import networks_of, onnx_of
from training.network_training import FrontEnd, Recording, Trainer
from training.recipes import (
    UNCHOSEN,
    Report,
    all_scores,
    choose_search,
    error_rate,
    report_rows,
    with_penalty,
    write_card,
)
from training.second_language import as_nearest_units, load_second_language
from training.unit_language import language_of_corpora, load_language

STATES_PER_UNIT = 3
NUM_STATES = STATES_PER_UNIT * len(UNITS)
LOOK_AHEADS_MS = (0, 10, 30, 60, 100, 200)  # of the output layers
LOOK_AHEAD_MS = 10  # of the main one: 35 ms after its onset a unit may be known
_SHARES = {"sentence": 0.5, "word": 0.17, "synthetic": 0.33}  # of the Mandarin frames heard
_SECOND_SHARE = 0.35  # of the second task, against 1 for all Mandarin
_ALIGNING_FRAMES = 6  # look-ahead: a unit's beginning is plainer with what follows
_REALIGNED_AT = 0.3  # of the steps: from there on the network's own alignment counts
_JUDGED_EVERY = 0.05  # of the steps: dev is recognised
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

    example: Example
    states: NDArray[np.int64]  # (frames,)
    units: list[AlignedUnit]


@dataclass(frozen=True, slots=True)
class _Statistics:
    """What an alignment says beside the network."""

    topology: Topology
    log_prior: NDArray[np.float32]  # (states,)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lessons:
    """What one network learns from, in which order."""

    corpora: Sequence[Path]
    aligner: Path
    second_task: Path | None
    start: Path | None
    language: Path | None
    look_ahead_ms: float
    num_steps: int
    num_voices: int
    shipping: bool


@dataclass(frozen=True, slots=True)
class _Trained:
    """A network and how it came about."""

    network: Network
    model: NeuralModel
    losses: list[tuple[int, float]]
    rates: list[tuple[int, float]]


def train_neural(
    corpora: Sequence[Path],
    output: Path,
    *,
    aligner: Path,
    second_task: Path | None = None,
    start: Path | None = None,
    language: Path | None = None,
    look_ahead_ms: float = LOOK_AHEAD_MS,
    seed: int = 0,
    num_steps: int = 4000,
    num_networks: int = 2,
    num_voices: int = 6,
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
        A model that aligns the first time, such as :func:`training.recipes.train_gmm` writes.
    second_task
        Folder of speech in English, see :func:`training.second_language.load_second_language`.
    start
        A model that this function has written, whose networks learn further, such as to know
        one's own speakers; else they begin anew.
    language
        What :func:`training.unit_language.train_language` has written; else the language is that
        of the corpora.
    look_ahead_ms
        Of the output layer that counts most and is in use, in whole frames of 10 ms.
    seed
        Of weights, order and augmentation of the first network; the others' are the next ones.
    num_steps
        Batches of 50 s of sound.
    num_networks
        Networks that learn side by side, each in a process of its own, and whose mean counts.
    num_voices
        Other voices for each real sentence.
    shipping
        Leave out rows whose licence forbids giving the model away.
    report
        Receives lines of progress; those of several networks are printed.

    Raises
    ------
    UserError
        If there is nothing to train on, or a file cannot be read.
    """
    if start:
        _begun(start, look_ahead_ms)  # finds mistakes before the long work
    errors = RowErrors()
    examples = load_examples(corpora, errors, shipping=shipping, num_voices=num_voices)
    if second_task:
        load_second_language(second_task, errors)  # finds mistakes and fills the cache for all
    lessons = _Lessons(
        corpora=corpora,
        aligner=aligner,
        second_task=second_task,
        start=start,
        language=language,
        look_ahead_ms=look_ahead_ms,
        num_steps=num_steps,
        num_voices=num_voices,
        shipping=shipping,
    )
    if num_networks == 1:
        trained = [_train_one(lessons, seed, report)]
    else:
        with ProcessPoolExecutor(num_networks, mp_context=get_context("spawn")) as processes:
            seeds = range(seed, seed + num_networks)
            trained = list(processes.map(partial(_train_one, lessons), seeds))
    unscaled = replace(
        trained[0].model, network=onnx_of([one.network for one in trained]), kappa=1.0
    )
    choice = choose_search(unscaled, corpora, scales=_SCALES, shipping=shipping, report=report)
    scale, penalty = (choice.scale, choice.unit_penalty) if choice else (_SCALE, _UNIT_PENALTY)
    replace(unscaled, topology=with_penalty(unscaled.topology, penalty), kappa=scale).save(output)
    draw_curves(trained, output.with_suffix(".png"))
    write_card(
        output,
        title=f"Neural recognizer, the mean of {num_networks} recurrent networks",
        details=f"seed {seed}, {num_steps} steps, {num_voices} other voices for each sentence, "
        f"aligned first by `{aligner.name}`" + (", with a second language" if second_task else ""),
        examples=examples,
        errors=errors,
        choice=choice or UNCHOSEN,
    )
    report_rows(errors, report)


def _train_one(lessons: _Lessons, seed: int, report: Report = print) -> _Trained:
    torch.set_num_threads(1)  # the networks share the cores; and sums come out the same everywhere
    torch.manual_seed(seed)

    def tell(line: str) -> None:
        report(f"network {seed}: {line}")

    examples = load_examples(
        lessons.corpora, RowErrors(), shipping=lessons.shipping, num_voices=lessons.num_voices
    )
    second: list[Example] = []
    if lessons.second_task:
        second = load_second_language(lessons.second_task, RowErrors())
    aligner = _aligner(load_model(lessons.aligner))
    aligned = _aligned(aligner, examples)
    of_second = _aligned(aligner, second, as_nearest_units(second)) if second else []
    tell(f"{len(aligned)} recordings aligned, {len(of_second)} of the second task")
    look_aheads = _look_aheads(lessons.look_ahead_ms)
    if lessons.start:
        begun, front_end = _begun(lessons.start, lessons.look_ahead_ms)
        network = begun[seed % len(begun)]
    else:
        network = Network(Shape(num_states=NUM_STATES, look_aheads=look_aheads))
        front_end = FrontEnd.measure(_recordings(aligned, []))
    trainer = Trainer(
        network,
        front_end,
        _recordings(aligned, of_second),
        main_head=look_aheads.index(round(lessons.look_ahead_ms / 1000 / HOP_S)),
        seed=seed,
    )
    if lessons.language:
        language = load_language(lessons.language)
    else:
        language = language_of_corpora(examples)
    statistics = _statistics(aligned, language)
    dev = _dev_examples(lessons.corpora, shipping=lessons.shipping)
    losses: list[tuple[int, float]] = []
    rates: list[tuple[int, float]] = []

    def watch(step: int, loss: float) -> None:
        nonlocal statistics
        losses.append((step, loss))
        if step == round(_REALIGNED_AT * lessons.num_steps):
            anew = _aligned(_aligner(_model(trainer, statistics)), examples)
            second_anew = []
            if second:
                heard = _model(trainer, _statistics(of_second, language), second_task=True)
                second_anew = _aligned(_aligner(heard), second)
            trainer.replace_recordings(_recordings(anew, second_anew))
            statistics = _statistics(anew, language)
            tell(f"step {step}: aligned anew")
        if dev and step % max(1, round(_JUDGED_EVERY * lessons.num_steps)) == 0:
            judged = _model(trainer, statistics)
            scores = list(all_scores(judged, dev))
            topology = with_penalty(judged.topology, _UNIT_PENALTY)
            rates.append((step, error_rate(topology, scores, dev)))
            rate = 100 * rates[-1][1]
            tell(f"step {step}: {loss:.3f} nats a frame, dev phone error {rate:.1f} %")

    trainer.train(lessons.num_steps, watch)
    return _Trained(trainer.mean, _model(trainer, statistics), losses, rates)


def _begun(path: Path, look_ahead_ms: float) -> tuple[list[Network], FrontEnd]:
    """Take the networks of a model to train them further, and how their input is normalised."""
    model = load_model(path)
    if isinstance(model, NeuralModel) and tuple(model.look_aheads) == _look_aheads(look_ahead_ms):
        front_end = FrontEnd(prior_mean=model.prior_mean, spread=model.spread)
        with suppress(KeyError):  # another network that runs in the same way
            return networks_of(model.network, model.look_aheads.tolist()), front_end
    raise UserError(
        f"{path} was not written by this command with a look-ahead of {look_ahead_ms:g} ms; begin "
        "with a model that was"
    )


def _look_aheads(main_ms: float) -> tuple[int, ...]:
    """Look-aheads of all output layers, feature frames."""
    return tuple(round(ms / 1000 / HOP_S) for ms in sorted({*LOOK_AHEADS_MS, main_ms}))


def _aligner(model: AcousticModel) -> AcousticModel:
    """Take a network's output layer that is best for alignment."""
    if not isinstance(model, NeuralModel):
        return model
    distance = np.abs(model.look_aheads - _ALIGNING_FRAMES)
    return replace(model, head=int(distance.argmin()), kappa=1.0)


def _aligned(
    model: AcousticModel, examples: Sequence[Example], heard_as: Sequence[Example] | None = None
) -> list[_Aligned]:
    """Find the states of all frames, ``STATES_PER_UNIT`` for each unit; drop what does not fit.

    ``heard_as`` holds the same with the units that the model takes theirs for.
    """
    aligned = []
    own = np.diff(model.topology.first_state)
    of_state = np.repeat(np.arange(len(UNITS)), own)
    place = np.arange(len(of_state)) - model.topology.first_state[of_state]
    # middle of the n-th part of a unit, in parts of another size
    part = (2 * place + 1) * STATES_PER_UNIT // (2 * own[of_state])
    rows = all_scores(model, examples)
    for scores, example, heard in zip(rows, examples, heard_as or examples, strict=True):
        graph = utterance_graph(heard.units, heard.syllables, model.topology.first_state)
        path, _ = viterbi_path(
            scores[:, graph.states], graph, model.topology.log_stay, model.topology.log_leave
        )
        if len(path):
            graph.units[graph.units != SIL] = example.units
            states = graph.units[graph.unit_of[path]] * STATES_PER_UNIT + part[graph.states[path]]
            aligned.append(_Aligned(example, states, units_of_path(path, graph)))
    if not aligned:
        raise UserError("no recording fits its text; is the aligner trained?")
    return aligned


def _recordings(aligned: Sequence[_Aligned], of_second: Sequence[_Aligned]) -> list[Recording]:
    """Weigh what the network hears; states of the second task follow the others."""
    second_frames = sum(len(one.states) for one in of_second)
    return [
        Recording(
            voices=(one.example.log_mel, *one.example.voices), targets=one.states, weight=weight
        )
        for one, weight in zip(aligned, _weights(aligned), strict=True)
    ] + [
        Recording(
            voices=(one.example.log_mel,),
            targets=NUM_STATES + one.states,
            weight=_SECOND_SHARE / second_frames,
        )
        for one in of_second
    ]


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


def _model(trainer: Trainer, statistics: _Statistics, *, second_task: bool = False) -> NeuralModel:
    """Make the recognizer's model of the running mean of the weights."""
    shape = trainer.network.shape
    main_look_ahead = shape.look_aheads[trainer.main_head]
    return NeuralModel(
        topology=statistics.topology,
        network=onnx_of([trainer.mean], second_task=second_task),
        look_aheads=np.array([main_look_ahead] if second_task else shape.look_aheads),
        log_prior=statistics.log_prior,
        prior_mean=trainer.front_end.prior_mean,
        spread=trainer.front_end.spread,
        kappa=_SCALE,
        head=0 if second_task else trainer.main_head,
    )


def _dev_examples(corpora: Sequence[Path], *, shipping: bool) -> list[Example]:
    try:
        return load_examples(corpora, RowErrors(), split="dev", shipping=shipping)
    except UserError:
        return []


def draw_curves(trained: Sequence[_Trained], path: Path) -> None:
    """Draw cross-entropy and dev phone error over the steps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 (slow to load)
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(6, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    left = figure.add_subplot()
    right = left.twinx()
    for number, one in enumerate(trained):
        steps, losses = np.array(one.losses).T
        width = min(_SMOOTHED, len(steps))
        smooth = np.convolve(losses, np.ones(width) / width, "valid")
        left.plot(steps[width - 1 :], smooth, f"C{number}", linewidth=0.8)
        if one.rates:
            right.plot(
                *zip(*((step, 100 * rate) for step, rate in one.rates), strict=True), f"o:C{number}"
            )
    left.set_xlabel("steps")
    left.set_ylabel("nats a frame (line)")
    right.set_ylabel("dev phone error % (dots)")
    right.set_ylim(bottom=0)
    figure.savefig(path, dpi=90)
