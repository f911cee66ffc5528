"""From corpora to the neural recognizer: alignment, training, realignment, search, model card."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from services.recognizer.acoustic_model import AcousticModel, Topology
from services.recognizer.load import load_model
from services.recognizer.neural import NeuralModel
from shared.errors import UserError
from shared.phones import UNITS
from training.corpus import RowErrors, Utterance, is_synthetic
from training.durations import AlignedUnit, UnitDurations
from training.examples import WORD_UNITS, Example, load_examples
from training.feature_cache import log_mel_of
from training.gmm import unit_bigram, units_of_path, utterance_graph, viterbi_path
from training.network import Network, Shape
from training.network_export import onnx_of
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

STATES_PER_UNIT = 3
LOOK_AHEADS = (0, 1, 3, 6)  # feature frames, of the output layers; the trunk forgets more
MAIN_HEAD = 1  # 10 ms: with N = 3 a unit is put out 55 ms after its first window begins
_SHARES = {"sentence": 0.5, "word": 0.17, "synthetic": 0.33}  # of the frames heard
_ALIGNING_HEAD = 3  # 60 ms: a unit's beginning is plainer with what follows
_REALIGNED_AT = 0.5  # of the steps: from there on the network's own alignment counts
_JUDGED_EVERY = 0.05  # of the steps: dev is recognised
_JUDGED_SCALE = 0.5
_BIGRAM_SCALE = 1.5  # of the unit bigram's log probabilities; chosen on development data
_PRIOR_SCALE = 0.5  # of the states' log shares; chosen on development data
_SCALES = (0.3, 0.4, 0.5, 0.6, 0.8)
_LEAST_STAY, _MOST_STAY = 0.05, 0.98
_SECOND_FRAMES_A_PHONE = 3  # a recording of the second task with fewer is left out


@dataclass(frozen=True, slots=True)
class _Aligned:
    """An utterance with its states."""

    example: Example
    states: NDArray[np.int64]  # (frames,)
    units: list[AlignedUnit]


def train_neural(
    corpora: Sequence[Path],
    output: Path,
    *,
    aligner: Path,
    second_task: Path | None = None,
    seed: int = 0,
    num_steps: int = 4000,
    num_voices: int = 4,
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
        Folder with a ``manifest.tsv`` of speech in another language (``utt_id``, ``path``,
        ``seconds`` and ``arpabet``, phones separated by spaces).
    seed
        Of weights, voices, order and augmentation.
    num_steps
        Batches of 50 s of sound.
    num_voices
        Other voices for each real sentence.
    shipping
        Leave out rows whose licence forbids giving the model away.
    report
        Receives lines of progress.

    Raises
    ------
    UserError
        If there is nothing to train on, or a file cannot be read.
    """
    torch.manual_seed(seed)
    errors = RowErrors()
    examples = load_examples(
        corpora, errors, shipping=shipping, num_voices=num_voices, voice_seed=seed
    )
    phones, second = _second_task(second_task, errors) if second_task else (0, [])
    aligned = _aligned(load_model(aligner), examples)
    report(f"{len(aligned)} recordings aligned, {len(second)} of the second task")
    recordings = _recordings(aligned)
    front_end = FrontEnd.measure(recordings)
    num_states = STATES_PER_UNIT * len(UNITS)
    shape = Shape(num_states=num_states, look_aheads=LOOK_AHEADS, num_second=phones)
    trainer = Trainer(Network(shape), front_end, recordings, second, main_head=MAIN_HEAD, seed=seed)
    dev = _dev_examples(corpora, shipping=shipping)
    losses: list[tuple[int, float]] = []
    rates: list[tuple[int, float]] = []

    def watch(step: int, loss: float) -> None:
        nonlocal aligned
        losses.append((step, loss))
        if step == round(_REALIGNED_AT * num_steps):
            anew = replace(_model(trainer, aligned), head=_ALIGNING_HEAD, kappa=1.0)
            aligned = _aligned(anew, examples)
            trainer.replace_recordings(_recordings(aligned))
            report(f"step {step}: aligned anew")
        if dev and step % max(1, round(_JUDGED_EVERY * num_steps)) == 0:
            judged = _model(trainer, aligned)
            scores = [all_scores(judged, example) for example in dev]
            rates.append((step, error_rate(judged.topology, scores, dev)))
            rate = 100 * rates[-1][1]
            report(f"step {step}: {loss:.3f} nats a frame, dev phone error {rate:.1f} %")

    trainer.train(num_steps, watch)
    model = _model(trainer, aligned)
    unscaled = replace(model, kappa=1.0)
    choice = choose_search(unscaled, corpora, scales=_SCALES, shipping=shipping, report=report)
    if choice is not None:
        topology = with_penalty(model.topology, choice.unit_penalty)
        model = replace(model, topology=topology, kappa=choice.scale)
    model.save(output)
    draw_curves(losses, rates, output.with_suffix(".png"))
    write_card(
        output,
        title=f"Neural recognizer, two recurrent layers of {shape.hidden} units",
        details=f"seed {seed}, {num_steps} steps, {num_voices} other voices for each sentence, "
        f"aligned first by `{aligner.name}`"
        + (f", with {len(second)} recordings in another language" if second else ""),
        examples=examples,
        errors=errors,
        choice=choice or UNCHOSEN,
    )
    report_rows(errors, report)


def _aligned(model: AcousticModel, examples: Sequence[Example]) -> list[_Aligned]:
    """Find the states of all frames, ``STATES_PER_UNIT`` for each unit; drop what does not fit."""
    aligned = []
    own = np.diff(model.topology.first_state)
    of_state = np.repeat(np.arange(len(UNITS)), own)
    place = np.arange(len(of_state)) - model.topology.first_state[of_state]
    # middle of the n-th part of a unit, in parts of another size
    coarse = of_state * STATES_PER_UNIT + (2 * place + 1) * STATES_PER_UNIT // (2 * own[of_state])
    for example in examples:
        scores = all_scores(model, example)
        graph = utterance_graph(example.units, example.syllables, model.topology.first_state)
        path, _ = viterbi_path(
            scores[:, graph.states], graph, model.topology.log_stay, model.topology.log_leave
        )
        if len(path):
            units = units_of_path(path, graph)
            aligned.append(_Aligned(example, coarse[graph.states[path]], units))
    if not aligned:
        raise UserError("no recording fits its text; is the aligner trained?")
    return aligned


def _recordings(aligned: Sequence[_Aligned]) -> list[Recording]:
    """Weigh what the network hears: each kind of speech has its share, rare speakers count more."""
    kinds = [_kind(one.example) for one in aligned]
    frames = dict.fromkeys(_SHARES, 0.0)
    for kind, one in zip(kinds, aligned, strict=True):
        frames[kind] += one.example.weight * len(one.states)
    return [
        Recording(
            voices=(one.example.log_mel, *one.example.voices),
            targets=one.states,
            weight=_SHARES[kind] * one.example.weight / frames[kind],
        )
        for kind, one in zip(kinds, aligned, strict=True)
    ]


def _kind(example: Example) -> str:
    if is_synthetic(example.licence):
        return "synthetic"
    return "sentence" if len(example.units) > WORD_UNITS else "word"


def _model(trainer: Trainer, aligned: Sequence[_Aligned]) -> NeuralModel:
    """Make the recognizer's model of the running mean of the weights."""
    num_states = STATES_PER_UNIT * len(UNITS)
    counts = np.ones(num_states)
    occupied, left = np.full(num_states, 2.0), np.ones(num_states)
    durations = UnitDurations()
    for one, recording in zip(aligned, _recordings(aligned), strict=True):
        of_states = np.bincount(one.states, minlength=num_states)
        counts += recording.weight * len(aligned) * of_states
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
        log_bigram=np.float32(_BIGRAM_SCALE) * unit_bigram([one.example.units for one in aligned]),
        duration_mean_s=mean_s,
        duration_spread_s=spread_s,
    )
    return NeuralModel(
        topology=topology,
        network=onnx_of(trainer.mean),
        look_aheads=np.array(LOOK_AHEADS),
        log_prior=(_PRIOR_SCALE * np.log(counts / counts.sum())).astype(np.float32),
        prior_mean=trainer.front_end.prior_mean,
        spread=trainer.front_end.spread,
        kappa=_JUDGED_SCALE,
        head=MAIN_HEAD,
    )


def _dev_examples(corpora: Sequence[Path], *, shipping: bool) -> list[Example]:
    try:
        return load_examples(corpora, RowErrors(), split="dev", shipping=shipping)
    except UserError:
        return []


def _second_task(folder: Path, errors: RowErrors) -> tuple[int, list[Recording]]:
    """Return the number of phones with the blank, which is 0, and recordings with their phones."""
    manifest = folder / "manifest.tsv"
    try:
        with manifest.open(encoding="utf-8", newline="") as lines:
            rows = list(csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE))
        strings = [row["arpabet"].split() for row in rows]
        utterances = [_of_second_task(folder, row) for row in rows]
    except (OSError, KeyError, ValueError) as error:
        raise UserError(
            f"{manifest} is no list of utt_id, path, seconds and arpabet ({error!r})"
        ) from error
    number = {
        phone: at
        for at, phone in enumerate(
            sorted({phone for string in strings for phone in string}), start=1
        )
    }
    recordings = [
        Recording(
            voices=(log_mel,),
            targets=np.array([number[phone] for phone in string]),
            weight=1.0,
            aligned=False,
        )
        for string, log_mel in zip(strings, log_mel_of(utterances, errors), strict=True)
        if log_mel is not None and len(log_mel) > _SECOND_FRAMES_A_PHONE * len(string) > 0
    ]
    if not recordings:
        raise UserError(f"{manifest} lists no recording that is long enough for its phones")
    return len(number) + 1, recordings


def _of_second_task(folder: Path, row: dict[str, str]) -> Utterance:
    return Utterance(
        utterance_id=row["utt_id"],
        path=folder / row["path"],
        speaker=row.get("speaker", ""),
        source="",
        licence="",
        split="train",
        seconds=float(row["seconds"]),
        units=(),
        syllables=(),
    )


def draw_curves(
    losses: Sequence[tuple[int, float]], rates: Sequence[tuple[int, float]], path: Path
) -> None:
    """Draw cross-entropy and dev phone error over the steps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 (slow to load)
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(6, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    left = figure.add_subplot()
    left.plot(*zip(*losses, strict=True), color="tab:blue", linewidth=0.8)
    left.set_xlabel("steps")
    left.set_ylabel("nats a frame", color="tab:blue")
    if rates:
        right = left.twinx()
        right.plot(*zip(*((step, 100 * rate) for step, rate in rates), strict=True), "o-C1")
        right.set_ylabel("dev phone error %", color="C1")
        right.set_ylim(bottom=0)
    figure.savefig(path, dpi=90)
