"""Tunes Whisper's encoder in blocks toward its own undisturbed output, and trains its readout.

Sources: Hinton, Vinyals and Dean 2015, "Distilling the knowledge in a neural network" (soft
targets); Romero et al. 2015, "FitNets: hints for thin deep nets" (hidden layers as targets).

    D = mean(clip((h - h_whole) / deviation, -6, 6)^2) over the layers that are read

    loss = H + D / 2, both for a block's own positions and, with half the weight, its right context

======== ============================================================= ==================
symbol   meaning                                                       shape
======== ============================================================= ==================
h        positions of the network after the layers that are read       (n, 3 width)
h_whole  output of the unchanged encoder, which sees the whole clean    (n, 3 width)
         audio
H        mean cross-entropy with the target states, nats a frame       1
======== ============================================================= ==================

Convolutions are frozen. A layer's rate is 0.85 of the rate of the layer above. Rates rise, stay
constant and fall to 0, and the result is a running mean of the weights. During the first steps, H
trains only the readout.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from kouxing.corpora.parallel import process_in_order
from kouxing.training.blocks.batches import (
    BATCHES_PER_STEP,
    BatchSource,
    BlockBatch,
    draw_block_batch,
)
from kouxing.training.blocks.network import BlockEncoder, BlockReadout, block_layout
from kouxing.training.device import DEVICE, mixed_precision
from kouxing.training.networks.network import MAX_DEVIATIONS
from kouxing.training.networks.optimizer import cross_entropy, optimize
from kouxing.training.networks.teacher import WholeEncoder

_LEARNING_RATE, _READOUT_LEARNING_RATE = 1.5e-4, 1.5e-3  # of the last layer, of the readout
_LAYER_RATE_DECAY = 0.85  # relative to the rate of the layer above
_READOUT_STEPS = 150
_WARM_UP_STEPS = 60
_DECAY_FRACTION = 0.6  # fraction of the steps, at the end, over which the rates fall to 0
_NUM_STANDARDIZED = 4  # batches that mean and deviation of the features are computed from
_JOINED = BATCHES_PER_STEP if DEVICE.type == "cuda" else 1  # batches that are computed together
_HIDDEN_WEIGHT, _RIGHT_WEIGHT = 0.5, 0.5  # weights of the losses


class BlockNetwork(nn.Module):
    """The encoder with its readout."""

    def __init__(self, encoder: BlockEncoder, readout: BlockReadout) -> None:
        super().__init__()
        self.encoder = encoder
        self.readout = readout


def train_network(
    network: BlockNetwork,
    teacher: WholeEncoder,
    batch_source: BatchSource,
    *,
    num_steps: int,
    checkpoint: Path,
) -> BlockNetwork:
    """Train the network in place; return one with the running mean of its weights.

    ``network`` has Whisper's weights and an untrained readout, ``teacher`` is Whisper's encoder.
    Training saves its state in ``checkpoint``, and resumes from it if the file exists.
    """
    first = [draw_block_batch(batch_source, number) for number in range(_NUM_STANDARDIZED)]
    with torch.no_grad():
        features = [
            teacher(_tensor([batch.clean]), batch.start)[:, : batch.states.shape[1]].flatten(0, 1)
            for batch in first
        ]
    network.readout.standardize(torch.cat(features).to(network.readout.mean.device))
    network.to(DEVICE).train()
    batches: Iterator[BlockBatch] | None = None

    def losses(step: int) -> Iterator[Tensor]:
        nonlocal batches
        if batches is None:
            numbers = range(BATCHES_PER_STEP * step, BATCHES_PER_STEP * num_steps)
            batches = process_in_order(partial(draw_block_batch, batch_source), numbers)
        for _ in range(0, BATCHES_PER_STEP, _JOINED):
            joined = list(islice(batches, _JOINED))
            part = _loss(network, teacher, joined, only_readout=step < _READOUT_STEPS)
            yield part * (_JOINED / BATCHES_PER_STEP)

    return optimize(
        network,
        _groups(network),
        losses,
        num_steps=num_steps,
        warm_up_steps=_WARM_UP_STEPS,
        decay_fraction=_DECAY_FRACTION,
        checkpoint=checkpoint,
    )


def _tensor(arrays: Sequence[NDArray[Any]]) -> Tensor:
    """Join arrays; floats get 32 bits, integers 64."""
    joined = torch.from_numpy(np.concatenate(arrays))
    if DEVICE.type == "cuda":
        joined = joined.pin_memory()  # copied while the GPU computes
    joined = joined.to(DEVICE, non_blocking=True)
    return joined.float() if joined.is_floating_point() else joined.long()


def _loss(
    network: BlockNetwork,
    teacher: WholeEncoder,
    batches: Sequence[BlockBatch],
    *,
    only_readout: bool,
) -> Tensor:
    """Compute the loss of batches of the same shape.

    With ``only_readout`` the cross-entropy does not train the encoder.
    """
    num_positions, start = batches[0].states.shape[1], batches[0].start
    layout = block_layout(num_positions, *batches[0].block, DEVICE)
    frames, clean, states, probs = (
        _tensor([getattr(batch, name) for batch in batches])
        for name in ("frames", "clean", "states", "probs")
    )
    with mixed_precision():
        with torch.no_grad():
            whole = teacher(clean, start)[:, layout.places]
        features = network.encoder(frames, layout, start).float()
    log_posteriors = network.readout.read(features.detach() if only_readout else features, layout)
    apart = ((features - whole) / network.readout.deviation).clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
    states, probs = states[:, layout.places], probs[:, layout.places]
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
        {
            "params": list(layer.parameters()),
            "lr": _LEARNING_RATE * _LAYER_RATE_DECAY ** (len(layers) - 1 - place),
        }
        for place, layer in enumerate(layers)
    ]
    return [*groups, {"params": list(network.readout.parameters()), "lr": _READOUT_LEARNING_RATE}]
