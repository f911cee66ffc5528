"""Tune Whisper's encoder in blocks toward its own undisturbed output, and train its readout.

Sources: Hinton, Vinyals and Dean 2015, "Distilling the knowledge in a neural network" (soft
targets); Romero et al. 2015, "FitNets: hints for thin deep nets" (hidden layers as targets).

    D = mean(clip((h - h_whole) / deviation, -6, 6)^2) over the layers that are read

    loss = H + D / 2, both for a block's own positions and, with half the weight, its right context

======== ============================================================= ==================
symbol   meaning                                                       shape
======== ============================================================= ==================
h        positions of the network after the layers that are read       (n, 3 width)
h_whole  those of the unchanged encoder, which sees the whole clean    (n, 3 width)
         audio
H        mean cross-entropy with the target states, nats a frame       1
======== ============================================================= ==================

Convolutions are frozen. A layer's rate is 0.85 of the rate of the layer above. Rates rise and then
stay constant, and the result is a running mean of the weights. Training can end after any step.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from kouxing.training.blocks.batches import BlockBatch, block_batch
from kouxing.training.blocks.network import BlockEncoder, BlockReadout, layout
from kouxing.training.device import mixed_precision
from kouxing.training.neural.batches import Recording
from kouxing.training.neural.network import MAX_DEVIATIONS
from kouxing.training.neural.optimizer import Optimizer, cross_entropy, warm_up_factor
from kouxing.training.neural.teacher import WholeEncoder
from kouxing.training.training_set import Report

_RATE, _READOUT_RATE = 1e-4, 6e-4  # of the last layer, of the readout
_RATE_BELOW = 0.85  # relative to the rate of the layer above
_WARM_UP_STEPS = 60
_HIDDEN_WEIGHT, _RIGHT_WEIGHT = 0.5, 0.5  # of a loss


class BlockNetwork(nn.Module):
    """The encoder with its readout."""

    def __init__(self, encoder: BlockEncoder, readout: BlockReadout) -> None:
        super().__init__()
        self.encoder = encoder
        self.readout = readout


def train_network(
    network: BlockNetwork,
    teacher: WholeEncoder,
    recordings: Sequence[Recording],
    *,
    seed: int,
    num_steps: int,
    checkpoint: Path,
    report: Report,
) -> BlockNetwork:
    """Train the network in place; return one with the running mean of its weights.

    ``network`` has Whisper's weights and a trained readout, ``teacher`` is Whisper's encoder.
    Training saves its state in ``checkpoint``, and resumes from it if the file exists.
    """
    groups = _groups(network)
    optimizer = Optimizer(network, groups, weight_decay=0.01, max_norm=2.0, mean_exponent=3)
    network.train()
    return optimizer.train(
        lambda step: _loss(network, teacher, block_batch(recordings, seed, step)),
        lambda step: warm_up_factor(step, _WARM_UP_STEPS),
        num_steps=num_steps,
        seed=seed,
        report=report,
        checkpoint=checkpoint,
    )


def _loss(network: BlockNetwork, teacher: WholeEncoder, batch: BlockBatch) -> Tensor:
    """Compute the loss of a batch."""
    num_positions = batch.states.shape[1]
    laid = layout(num_positions, batch.block_length)
    with mixed_precision():
        with torch.no_grad():
            whole = teacher(batch.clean, batch.start)[:, laid.places]
        features = network.encoder(batch.frames, laid, batch.start).float()
    log_posteriors = network.readout.read(features, laid)
    apart = ((features - whole) / network.readout.deviation).clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
    states, probs = batch.states[:, laid.places], batch.probs[:, laid.places]
    losses = []
    for part in (slice(num_positions), slice(num_positions, None)):
        entropy = cross_entropy(log_posteriors[:, part], states[:, part], probs[:, part])
        losses.append(entropy + _HIDDEN_WEIGHT * apart[:, part].square().mean())
    result: Tensor = losses[0] + _RIGHT_WEIGHT * losses[1]
    return result


def _groups(network: BlockNetwork) -> list[dict[str, object]]:
    """Freeze the convolutions; return the other parameters with their rates."""
    for convolution in (network.encoder.first, network.encoder.second):
        convolution.requires_grad_(False)
    layers = list(network.encoder.layers)
    groups: list[dict[str, object]] = [
        {"params": list(layer.parameters()), "lr": _RATE * _RATE_BELOW ** (len(layers) - 1 - place)}
        for place, layer in enumerate(layers)
    ]
    return [*groups, {"params": list(network.readout.parameters()), "lr": _READOUT_RATE}]
