"""From corpora to the neural recognizer: alignment, teacher, training, search weights, model card.

The network starts with the weights of Whisper's encoder or of an earlier model, and learns the
states of a forced alignment. The earlier model aligns the recordings. Otherwise another model
aligns at first, and the network itself after half of the steps. The network aligns with an output
layer of 30 ms look-ahead, because the onset of a phone is clearer with some of its continuation.

With Whisper there is also a teacher (:mod:`kouxing.training.neural.teacher`), trained on the first
alignment, which sees whole recordings. The targets are the average of alignment and teacher, or
only the teacher's labels for recordings without text.

The recognizer emits phones early and corrects them. Acoustic scale and phone penalty therefore
minimize the errors on dev of both the first hypothesis and offline decoding (full traceback).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kouxing.corpora.figures import new_figure, save_figure
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.features import HOP_S
from kouxing.shared.errors import UserError
from kouxing.training.model_card import write_card
from kouxing.training.neural.alignment import (
    AlignedExample,
    Statistics,
    align_all,
    aligner_scores,
    aligning_output,
    first_hypothesis_error_rate,
    network_scores,
    samples_of,
    statistics_of,
)
from kouxing.training.neural.batches import Recording, Targets
from kouxing.training.neural.export import onnx_of
from kouxing.training.neural.initial_network import (
    FRAME_MS,
    all_look_aheads,
    init_encoder,
    init_network,
)
from kouxing.training.neural.teacher import WholeEncoder, process_all, train_teacher
from kouxing.training.neural.trainer import BATCH_S, Trainer
from kouxing.training.phone_lm.recipe import load_phone_lm, phone_lm_of
from kouxing.training.search_weights import (
    SearchWeights,
    choose_search_weights,
    load_dev,
    offline_error_rate,
)
from kouxing.training.training_set import Example, Report, load_examples, load_untranscribed

_SMOOTHED_STEPS = 20


def draw_curves(
    losses: Sequence[tuple[int, float]], error_rates: Sequence[tuple[int, float]], path: Path
) -> None:
    """Draw cross-entropy (nats a frame) and dev phone error rate over the steps.

    Both are pairs of step and value. There may be no error rates.
    """
    figure = new_figure(6.0, 3.2)
    left = figure.add_subplot()
    right = left.twinx()
    steps, nats = np.array(losses).T
    width = min(_SMOOTHED_STEPS, len(steps))
    left.plot(steps[width - 1 :], np.convolve(nats, np.ones(width) / width, "valid"), linewidth=0.8)
    if error_rates:
        right.plot(*zip(*((step, 100 * rate) for step, rate in error_rates), strict=True), "o:")
    left.set_xlabel("steps")
    left.set_ylabel("nats a frame (line)")
    right.set_ylabel("dev phone error % (dots)")
    right.set_ylim(bottom=0)
    save_figure(figure, path)


LOOK_AHEAD_MS = 10.0  # of the main output layer: a phone may be known 35 ms after its onset
NUM_STEPS = 800
_MIX = {"sentence": 0.33, "word": 0.08, "synthetic": 0.30}  # fraction of the frames sampled
_UNTRANSCRIBED_MIX = 0.29  # likewise
_TEACHER_SET = 1000  # recordings of each kind that the teacher is trained on
_REALIGN_AT = 0.5  # fraction of the steps after which the network aligns itself
_TEST_EVERY = 0.1  # fraction of the steps between two tests on dev
_UNTUNED = SearchWeights(acoustic_scale=0.5, phone_penalty=1.0)
_ACOUSTIC_SCALES = (0.3, 0.4, 0.5, 0.6, 0.8, 1.0)


def train_neural(
    corpora: Sequence[Path],
    output: Path,
    *,
    aligner: Path | None = None,
    whisper: Path | None = None,
    start: Path | None = None,
    untranscribed: Sequence[Path] = (),
    phone_lm: Path | None = None,
    look_ahead_ms: float = LOOK_AHEAD_MS,
    seed: int = 0,
    num_steps: int = NUM_STEPS,
    num_threads: int | None = None,
    shipping: bool = True,
    report: Report = print,
) -> None:
    """Train the neural recognizer, and write the model with its card and training curves.

    The arguments are the options of ``kouxing train neural``. The language is that of the model
    that aligns: ``aligner``, or else ``start``. Without ``whisper`` there is no teacher, and the
    network starts with the weights of ``start``. The same seed and number of threads give the same
    model on the same kind of processor. Raises UserError if there is nothing to train on or to
    start with, no model that aligns, no teacher for recordings without text, or a file cannot be
    read.
    """
    if untranscribed and whisper is None:
        raise UserError("recordings without text need a teacher; also give --whisper")
    torch.set_num_threads(num_threads or os.cpu_count() or 1)
    torch.manual_seed(seed)
    before = load_model(start) if start else None
    first = load_model(aligner) if aligner else before
    if first is None:
        raise UserError("no model can align the recordings; give --aligner or --start-from")
    inventory = first.inventory
    network = init_network(whisper, before, inventory, all_look_aheads(look_ahead_ms))
    encoder = init_encoder(whisper, network.shape.num_states) if whisper else None
    errors = RowErrors()
    examples = load_examples(corpora, errors, inventory, shipping=shipping, with_samples=True)
    sounds = load_untranscribed(untranscribed, errors) if untranscribed else []
    lm = load_phone_lm(phone_lm, inventory) if phone_lm else phone_lm_of(examples, inventory)
    aligned = align_all(aligner_scores(first, examples), first.topology, examples, report)
    report(f"{len(aligned)} of them fit their text")
    labels, without_text, teacher_details = _teach(encoder, aligned, examples, sounds, seed, report)
    trainer = Trainer(
        network,
        _recordings(aligned, labels) + without_text,
        main_output=network.shape.look_aheads.index(round(look_ahead_ms / FRAME_MS)),
        seed=seed,
    )
    dev = load_dev(corpora, inventory, shipping=shipping, with_samples=True)
    statistics = statistics_of(aligned, _weights(aligned), lm)
    losses, error_rates = [], []
    for step, loss in trainer.train(num_steps):
        losses.append((step, loss))
        if aligner and step == round(_REALIGN_AT * num_steps):
            aligned = _realign(trainer, statistics, examples, report)
            trainer.replace_recordings(_recordings(aligned, labels) + without_text)
            statistics = statistics_of(aligned, _weights(aligned), lm)
            report(f"step {step}: realigned")
        if step % max(1, round(_TEST_EVERY * num_steps)) == 0:
            dev_error = ""
            if dev:
                error_rates.append((step, _error_rate(trainer, statistics, dev)))
                dev_error = f", dev phone error {100 * error_rates[-1][1]:.1f} %"
            report(f"step {step}: {loss:.3f} nats a frame{dev_error}")
    unscaled = NeuralModel(
        topology=statistics.topology,
        network=onnx_of(trainer.mean),
        look_aheads=np.array(network.shape.look_aheads),
        log_prior=statistics.log_prior,
        acoustic_scale=1.0,
        output_layer=trainer.main_output,
    )
    chosen = _choose_search_weights(unscaled, corpora, shipping, report)
    (chosen or _UNTUNED).applied_to(unscaled).save(output)
    draw_curves(losses, error_rates, output.with_suffix(".png"))
    source = f"`{start.name}`" if start else "Whisper's weights (Radford et al. 2023, MIT license)"
    write_card(
        output,
        title=f"Neural recognizer, a causal transformer of {network.shape.layers} layers",
        details=f"started with {source}, seed {seed}, {num_steps} steps of {BATCH_S} s of sound, "
        f"aligned by {f'`{aligner.name}` at first' if aligner else 'the same model'}"
        f"{teacher_details}",
        examples=examples,
        errors=errors,
        chosen=chosen,
        measure="mean of the phone error rates of offline decoding and of the first hypothesis",
    )
    errors.print_to(report)


def _choose_search_weights(
    model: NeuralModel, corpora: Sequence[Path], shipping: bool, report: Report
) -> SearchWeights | None:
    def rate(
        topology: Topology, scores: Sequence[NDArray[np.float32]], examples: Sequence[Example]
    ) -> float:
        weighted = replace(model, topology=topology)
        first_rate = first_hypothesis_error_rate(weighted, scores, examples)
        return (offline_error_rate(topology, scores, examples) + first_rate) / 2

    return choose_search_weights(
        model,
        corpora,
        scales=_ACOUSTIC_SCALES,
        shipping=shipping,
        with_samples=True,
        rate=rate,
        report=report,
    )


def _teach(
    encoder: WholeEncoder | None,
    aligned: Sequence[AlignedExample],
    examples: Sequence[Example],
    sounds: Sequence[NDArray[np.int16]],
    seed: int,
    report: Report,
) -> tuple[list[Targets], list[Recording], str]:
    """Return the teacher's labels, recordings that only it labels, and a description."""
    if encoder is None:
        return [], [], ""
    teacher_set = _recordings(sample_teacher_set(aligned, seed), [])
    teacher = train_teacher(encoder, teacher_set, seed=seed, report=report)
    recordings = [*map(samples_of, examples), *sounds]
    labels = process_all(teacher.targets_of, recordings, "labeled by the teacher", report)
    details = ", with a readout of Whisper's whole encoder as the teacher"
    num_frames = sum(map(len, labels[len(examples) :]))
    if sounds:
        details += f", also on {num_frames * HOP_S / 60:.1f} minutes without text"
    without_text = [
        Recording(samples=samples, targets=targets, weight=_UNTRANSCRIBED_MIX / num_frames)
        for samples, targets in zip(sounds, labels[len(examples) :], strict=True)
    ]
    return labels, without_text, details


def _realign(
    trainer: Trainer, statistics: Statistics, examples: Sequence[Example], report: Report
) -> list[AlignedExample]:
    layer = aligning_output(trainer.network.shape.look_aheads)
    scores = network_scores(trainer.mean, layer, statistics.log_prior, examples)
    return align_all(scores, statistics.topology, examples, report)


def _error_rate(trainer: Trainer, statistics: Statistics, dev: Sequence[Example]) -> float:
    scores = network_scores(trainer.mean, trainer.main_output, statistics.log_prior, dev)
    scaled = [np.float32(_UNTUNED.acoustic_scale) * rows for rows in scores]
    topology = replace(statistics.topology, phone_penalty=_UNTUNED.phone_penalty)
    return offline_error_rate(topology, scaled, dev)


def sample_teacher_set(aligned: Sequence[AlignedExample], seed: int) -> list[AlignedExample]:
    """Sample the recordings that the teacher is trained on, the same number of each kind."""
    rng = np.random.default_rng(seed)
    sampled = []
    for kind in _MIX:
        of_kind = [one for one in aligned if one.example.kind == kind]
        sampled += [of_kind[place] for place in rng.permutation(len(of_kind))[:_TEACHER_SET]]
    return sampled


def _recordings(aligned: Sequence[AlignedExample], labels: Sequence[Targets]) -> list[Recording]:
    recordings = []
    for one, weight in zip(aligned, _weights(aligned), strict=True):
        targets = Targets.hard(one.states)
        if labels:
            targets = targets.averaged_with(labels[one.number])
        samples = samples_of(one.example)
        recordings.append(Recording(samples=samples, targets=targets, weight=weight))
    return recordings


def _weights(aligned: Sequence[AlignedExample]) -> list[float]:
    """Weight each recording: kinds of speech have fixed fractions, rare speakers count more."""
    kinds = [one.example.kind for one in aligned]
    frames = dict.fromkeys(_MIX, 0.0)
    for kind, one in zip(kinds, aligned, strict=True):
        frames[kind] += one.example.weight * len(one.states)
    return [
        _MIX[kind] * one.example.weight / frames[kind]
        for kind, one in zip(kinds, aligned, strict=True)
    ]
