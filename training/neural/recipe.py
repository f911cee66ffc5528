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
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.features import HOP_S
from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from kouxing.shared.errors import UserError
from kouxing.training.model_card import write_card
from kouxing.training.neural.alignment import (
    AlignedExample,
    Statistics,
    align_all,
    aligner_scores,
    aligning_output,
    statistics_of,
)
from kouxing.training.neural.batches import Recording, Targets
from kouxing.training.neural.curves import draw_curves
from kouxing.training.neural.export import onnx_of
from kouxing.training.neural.initial_network import (
    FRAME_MS,
    all_look_aheads,
    init_encoder,
    init_network,
)
from kouxing.training.neural.scoring import first_hypothesis_error_rate, network_scores, samples_of
from kouxing.training.neural.teacher import Teacher, process_all, train_teacher
from kouxing.training.neural.trainer import BATCH_S, Trainer
from kouxing.training.phone_lm.recipe import load_phone_lm, phone_lm_of
from kouxing.training.progress import Report
from kouxing.training.search_weights import (
    SearchWeights,
    choose_search_weights,
    load_dev,
    offline_error_rate,
)
from kouxing.training.training_set import Example, load_examples, load_untranscribed

LOOK_AHEAD_MS = 10.0  # of the main output layer: a phone may be known 35 ms after its onset
NUM_STEPS = 800
_MIX = {"sentence": 0.33, "word": 0.08, "synthetic": 0.30}  # fraction of the frames sampled
_UNTRANSCRIBED_MIX = 0.29  # likewise
_TEACHER_SET = 1000  # recordings of each kind that the teacher is trained on
_REALIGN_AT = 0.5  # fraction of the steps after which the network aligns itself
_TEST_EVERY = 0.1  # fraction of the steps between two tests on dev
_UNTUNED = SearchWeights(acoustic_scale=0.5, phone_penalty=1.0)
_ACOUSTIC_SCALES = (0.3, 0.4, 0.5, 0.6, 0.8, 1.0)


@dataclass(frozen=True, slots=True)
class TeacherLabels:
    """The teacher's targets; empty without a teacher."""

    examples: list[Targets] = field(default_factory=list)  # of each example
    untranscribed: list[Recording] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class _Monitor:
    """Watches the training: realigns once, and tests on dev regularly."""

    trainer: Trainer
    examples: Sequence[Example]
    dev: Sequence[Example]
    labels: TeacherLabels
    phone_lm: PhoneLanguageModel
    statistics: Statistics
    num_steps: int
    realign_at: int | None  # step
    report: Report
    losses: list[tuple[int, float]] = field(default_factory=list)
    error_rates: list[tuple[int, float]] = field(default_factory=list)

    def watch(self, step: int, loss: float) -> None:
        """Record a step."""
        self.losses.append((step, loss))
        if step == self.realign_at:
            self._realign()
            self.report(f"step {step}: realigned")
        if step % max(1, round(_TEST_EVERY * self.num_steps)) == 0:
            line = f"step {step}: {loss:.3f} nats a frame"
            if self.dev:
                self.error_rates.append((step, self._dev_error_rate()))
                line += f", dev phone error {100 * self.error_rates[-1][1]:.1f} %"
            self.report(line)

    def _realign(self) -> None:
        network = self.trainer.mean
        output = aligning_output(network.shape.look_aheads)
        scores = network_scores(network, output, self.statistics.log_prior, self.examples)
        aligned = align_all(scores, self.statistics.topology, self.examples, self.report)
        self.trainer.replace_recordings(_recordings(aligned, self.labels))
        self.statistics = statistics_of(aligned, _weights(aligned), self.phone_lm)

    def _dev_error_rate(self) -> float:
        network, output = self.trainer.mean, self.trainer.main_output
        scores = network_scores(network, output, self.statistics.log_prior, self.dev)
        scaled = [np.float32(_UNTUNED.acoustic_scale) * rows for rows in scores]
        topology = replace(self.statistics.topology, phone_penalty=_UNTUNED.phone_penalty)
        return offline_error_rate(topology, scaled, self.dev)


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
    network starts with the weights of ``start``. ``shipping`` excludes rows whose license does not
    allow distributing the model. The same seed and number of threads give the same model on the
    same kind of processor.

    Raises
    ------
    UserError
        If there is nothing to train on or to start with, no model that aligns, no teacher for
        recordings without text, or a file cannot be read.
    """
    if untranscribed and whisper is None:
        raise UserError("recordings without text need a teacher; also give --whisper")
    torch.set_num_threads(num_threads or os.cpu_count() or 1)
    torch.manual_seed(seed)
    before = load_model(start) if start else None
    first = load_model(aligner) if aligner else before
    if first is None:
        raise UserError("no model aligns the recordings; give --aligner or --start-from")
    inventory = first.inventory
    network = init_network(whisper, before, inventory, all_look_aheads(look_ahead_ms))
    encoder = init_encoder(whisper, network.shape.num_states) if whisper else None
    errors = RowErrors()
    examples = load_examples(corpora, errors, inventory, shipping=shipping, with_samples=True)
    sounds = load_untranscribed(untranscribed, errors) if untranscribed else []
    lm = load_phone_lm(phone_lm, inventory) if phone_lm else phone_lm_of(examples, inventory)
    aligned = align_all(aligner_scores(first, examples), first.topology, examples, report)
    report(f"{len(aligned)} of them fit their text")
    labels = TeacherLabels()
    if encoder:
        teacher_set = _recordings(sample_teacher_set(aligned, seed), labels)
        teacher = train_teacher(encoder, teacher_set, seed=seed, report=report)
        labels = _label(teacher, examples, sounds, report)
    trainer = Trainer(
        network,
        _recordings(aligned, labels),
        main_output=network.shape.look_aheads.index(round(look_ahead_ms / FRAME_MS)),
        seed=seed,
    )
    monitor = _Monitor(
        trainer=trainer,
        examples=examples,
        dev=load_dev(corpora, inventory, shipping=shipping, with_samples=True),
        labels=labels,
        phone_lm=lm,
        statistics=statistics_of(aligned, _weights(aligned), lm),
        num_steps=num_steps,
        realign_at=round(_REALIGN_AT * num_steps) if aligner else None,
        report=report,
    )
    trainer.train(num_steps, monitor.watch)
    unscaled = _model(trainer, monitor.statistics)

    def rate(
        topology: Topology, scores: Sequence[NDArray[np.float32]], examples: Sequence[Example]
    ) -> float:
        model = replace(unscaled, topology=topology)
        first_rate = first_hypothesis_error_rate(model, scores, examples)
        return (offline_error_rate(topology, scores, examples) + first_rate) / 2

    chosen = choose_search_weights(
        unscaled,
        corpora,
        scales=_ACOUSTIC_SCALES,
        shipping=shipping,
        with_samples=True,
        rate=rate,
        report=report,
    )
    (chosen or _UNTUNED).applied_to(unscaled).save(output)
    draw_curves(monitor.losses, monitor.error_rates, output.with_suffix(".png"))
    source = f"`{start.name}`" if start else "Whisper's weights (Radford et al. 2023, MIT license)"
    write_card(
        output,
        title=f"Neural recognizer, a causal transformer of {network.shape.layers} layers",
        details=f"started with {source}, seed {seed}, {num_steps} steps of {BATCH_S} s of sound, "
        f"aligned by {f'`{aligner.name}` at first' if aligner else 'the same model'}"
        + _teacher_details(labels),
        examples=examples,
        errors=errors,
        chosen=chosen,
        measure="mean of the phone error rates of offline decoding and of the first hypothesis",
    )
    errors.print_to(report)


def sample_teacher_set(aligned: Sequence[AlignedExample], seed: int) -> list[AlignedExample]:
    """Sample the recordings that the teacher is trained on, the same number of each kind."""
    rng = np.random.default_rng(seed)
    sampled = []
    for kind in _MIX:
        of_kind = [one for one in aligned if one.example.kind == kind]
        sampled += [of_kind[place] for place in rng.permutation(len(of_kind))[:_TEACHER_SET]]
    return sampled


def _label(
    teacher: Teacher,
    examples: Sequence[Example],
    sounds: Sequence[NDArray[np.int16]],
    report: Report,
) -> TeacherLabels:
    recordings = [*map(samples_of, examples), *sounds]
    targets = process_all(teacher.targets_of, recordings, "labeled by the teacher", report)
    untranscribed = targets[len(examples) :]
    num_frames = sum(map(len, untranscribed))
    return TeacherLabels(
        targets[: len(examples)],
        [
            Recording(samples=samples, targets=one, weight=_UNTRANSCRIBED_MIX / num_frames)
            for samples, one in zip(sounds, untranscribed, strict=True)
        ],
    )


def _teacher_details(labels: TeacherLabels) -> str:
    """Describe the teacher for the card, and how much it labeled without text."""
    if not labels.examples:
        return ""
    details = ", with a readout of Whisper's whole encoder as the teacher"
    if labels.untranscribed:
        minutes = sum(len(recording.targets) for recording in labels.untranscribed) * HOP_S / 60
        details += f", also on {minutes:.1f} minutes without text"
    return details


def _recordings(aligned: Sequence[AlignedExample], labels: TeacherLabels) -> list[Recording]:
    recordings = []
    for one, weight in zip(aligned, _weights(aligned), strict=True):
        targets = Targets.hard(one.states)
        if labels.examples:
            targets = targets.averaged_with(labels.examples[one.number])
        samples = samples_of(one.example)
        recordings.append(Recording(samples=samples, targets=targets, weight=weight))
    return recordings + labels.untranscribed


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


def _model(trainer: Trainer, statistics: Statistics) -> NeuralModel:
    """Make the recognizer's model from the running mean of the weights; acoustic scale 1."""
    return NeuralModel(
        topology=statistics.topology,
        network=onnx_of(trainer.mean),
        look_aheads=np.array(trainer.network.shape.look_aheads),
        log_prior=statistics.log_prior,
        acoustic_scale=1.0,
        output_layer=trainer.main_output,
    )
