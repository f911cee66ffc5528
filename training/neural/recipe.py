"""From corpora to the neural recognizer: labels, training, search weights, model card.

A causal network starts with Whisper's first layers, and learns the labels of
:mod:`kouxing.training.neural.labels` on the excerpts of :mod:`kouxing.training.blocks.batches`.
Every step trains the output layer of the shortest look-ahead, and one of the others in turn. Its
convolutions are frozen; pretrained layers have a lower learning rate than new ones.

    rate(n) = rate * min(1, (n + 1) / 60)

    loss = H(first output) + H(another output) / 2
    H = - sum_t sum_j q[t, j] log y[t, s[t, j]] / sum_t sum_j q[t, j]

======== ============================================================= ================
symbol   meaning                                                       shape
======== ============================================================= ================
n        number of a step                                              1
s, q     target states of a frame and their probabilities, which sum   (frames, k)
         to 1, or to 0 if no target is known
y        posteriors of the states, of an output layer                  (frames, states)
H        mean cross-entropy of an output layer, nats a frame           1
======== ============================================================= ================

Source: Hinton, Vinyals and Dean 2015, "Distilling the knowledge in a neural network" (soft
targets).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.training.blocks.batches import BATCH_S, Material, block_batch
from kouxing.training.device import mixed_precision
from kouxing.training.model_card import write_card
from kouxing.training.neural.batches import Recording
from kouxing.training.neural.export import onnx_of
from kouxing.training.neural.initial_network import init_encoder, init_network
from kouxing.training.neural.labels import STATES_PER_PHONE, Mix, label, statistics_of
from kouxing.training.neural.network import Network, output_frames
from kouxing.training.neural.optimizer import Optimizer, cross_entropy, warm_up_factor
from kouxing.training.phone_lm.recipe import load_phone_lm, phone_lm_of
from kouxing.training.search_weights import SearchWeights, choose_search_weights
from kouxing.training.training_set import Report, load_examples

LOOK_AHEADS = (1, 3, 6, 10, 20)  # of the output layers, feature frames
_MIX = Mix({"sentence": 0.33, "word": 0.08, "synthetic": 0.30}, 0.29)
_UNTUNED = SearchWeights(acoustic_scale=0.5, phone_penalty=1.0)
_ACOUSTIC_SCALES = (0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
_RATE, _NEW_RATE = 2e-4, 1.2e-3
_FROZEN, _NEW = ("first.", "second."), ("norm.", "outputs.")
_WARM_UP_STEPS = 60
_OTHER_OUTPUT_WEIGHT = 0.5  # of the loss of the other output layer


def train_neural(
    corpora: Sequence[Path],
    output: Path,
    *,
    aligner: Path,
    whisper: Path,
    untranscribed: Sequence[Path] = (),
    phone_lm: Path | None = None,
    seed: int = 0,
    num_steps: int = 800,
    shipping: bool = True,
    report: Report = print,
) -> None:
    """Train the neural recognizer, and write the model with its card.

    The arguments are the options of ``kouxing train neural``. The language is that of ``aligner``.
    Raises UserError if there is nothing to train on, or a file cannot be read.
    """
    torch.manual_seed(seed)
    model = load_model(aligner)
    inventory = model.inventory
    num_states = STATES_PER_PHONE * len(inventory)
    encoder = init_encoder(whisper, num_states)
    network = init_network(whisper, num_states, LOOK_AHEADS)
    errors = RowErrors()
    examples = load_examples(corpora, errors, inventory, shipping=shipping, with_samples=True)
    lm = load_phone_lm(phone_lm, inventory) if phone_lm else phone_lm_of(examples, inventory)
    aligned, recordings = label(
        examples,
        untranscribed,
        _MIX,
        aligner=model,
        encoder=encoder,
        errors=errors,
        seed=seed,
        report=report,
    )
    weights = [recording.weight for recording in recordings[: len(aligned)]]
    topology, log_prior = statistics_of(aligned, weights, lm)
    trained = train_network(network, recordings, seed=seed, num_steps=num_steps, report=report)
    unscaled = NeuralModel(
        topology=topology,
        network=onnx_of(trained),
        look_aheads=np.array(LOOK_AHEADS),
        log_prior=log_prior,
        acoustic_scale=1.0,
    )
    chosen = choose_search_weights(
        unscaled,
        corpora,
        scales=_ACOUSTIC_SCALES,
        shipping=shipping,
        with_samples=True,
        report=report,
    )
    (chosen or _UNTUNED).applied_to(unscaled).save(output)
    write_card(
        output,
        title=f"Neural recognizer, a causal transformer of {network.shape.layers} layers",
        details=f"with Whisper's weights (Radford et al. 2023, MIT license), seed {seed}, "
        f"{num_steps} steps of {BATCH_S} s of sound, aligned by `{aligner.name}`, on "
        f"{len(recordings)} recordings",
        recordings=examples,
        errors=errors,
        chosen=chosen,
    )
    errors.report_to(report)


def train_network(
    network: Network, recordings: Sequence[Recording], *, seed: int, num_steps: int, report: Report
) -> Network:
    """Train the network in place; return one with the running mean of its weights."""
    pretrained: list[nn.Parameter] = []
    new: list[nn.Parameter] = []
    for name, parameter in network.named_parameters():
        if name.startswith(_FROZEN):
            parameter.requires_grad_(False)
        else:
            (new if name.startswith(_NEW) else pretrained).append(parameter)
    groups = [{"params": pretrained, "lr": _RATE}, {"params": new, "lr": _NEW_RATE}]
    optimizer = Optimizer(network, groups, weight_decay=0.01, max_norm=1.0, mean_exponent=2)
    look_aheads = network.shape.look_aheads
    network.train()

    def loss(step: int) -> Tensor:
        batch = block_batch(Material(recordings), seed, step)
        frames, states, probs = map(torch.from_numpy, (batch.frames, batch.states, batch.probs))
        states, probs = states.long().flatten(1, 2), probs.float().flatten(1, 2)
        with mixed_precision():
            hidden = network(frames.float(), batch.start)
            losses = [
                cross_entropy(
                    network.log_posteriors(hidden, layer),
                    *_shift_targets(states, probs, hidden.shape[1], look_aheads[layer]),
                )
                for layer in (0, 1 + step % (len(look_aheads) - 1))
            ]
        return losses[0] + _OTHER_OUTPUT_WEIGHT * losses[1]

    return optimizer.train(
        loss,
        lambda step: warm_up_factor(step, _WARM_UP_STEPS),
        num_steps=num_steps,
        seed=seed,
        report=report,
    )


def _shift_targets(
    states: Tensor, probs: Tensor, num_positions: int, look_ahead_frames: int
) -> tuple[Tensor, Tensor]:
    """Find the targets of each position's two output frames.

    States and probabilities, (batch, frames, k), become (batch, positions, 2, k). The probabilities
    of frames outside the recording are 0.
    """
    num_frames = states.shape[1]
    frames = output_frames(num_positions, look_ahead_frames)
    inside = (frames >= 0) & (frames < num_frames)
    at = frames.clamp(0, num_frames - 1)
    return states[:, at], probs[:, at] * inside[..., None]
