"""Tune Whisper's encoder in blocks towards itself undisturbed and whole, and train its readout.

Sources: Hinton, Vinyals and Dean 2015, "Distilling the knowledge in a neural network" (soft
targets); Romero et al. 2015, "FitNets: hints for thin deep nets" (hidden layers as targets);
Loshchilov and Hutter 2019, "Decoupled weight decay regularization" (AdamW).

    D = mean(clip((h - h_whole) / deviation, -6, 6)^2) over the layers that are read

    loss = H + D / 2, both of own positions, and again, with half the weight, of right contexts

======== ============================================================= ==================
symbol   meaning                                                       shape
======== ============================================================= ==================
h        positions of the network after the layers that are read       (n, 3 width)
h_whole  those of the encoder as it was, which hears the sound clean   (n, 3 width)
         and whole
H        mean cross-entropy with the target states, nats a frame       1
======== ============================================================= ==================

Convolutions are frozen; a layer's rate is 0.85 of the rate of the layer above. Rates rise and then
stay, and a running mean of the weights is the result, so training can end after any step.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from kouxing.training.blocks.batches import BlockBatch, block_batch
from kouxing.training.blocks.network import BlockEncoder, BlockReadout, layout
from kouxing.training.blocks.readout import MAX_DEVIATIONS
from kouxing.training.neural.batches import Recording
from kouxing.training.neural.network import mixed_precision
from kouxing.training.neural.teacher import WholeEncoder
from kouxing.training.neural.trainer import cross_entropy, late_mean, take_step
from kouxing.training.progress import Report

_RATE, _READOUT_RATE = 1e-4, 6e-4  # of the last layer, of the readout
_RATE_BELOW = 0.85  # relative to the rate of the layer above
_WARM_UP_STEPS = 60
_WEIGHT_DECAY = 0.01
_MAX_GRADIENT_NORM = 2.0
_MEAN_EXPONENT = 3  # of the running mean of the weights
_HIDDEN_WEIGHT, _RIGHT_WEIGHT = 0.5, 0.5  # of a loss
_KEEP_EVERY = 25  # steps


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
    kept: Path,
    report: Report,
) -> BlockNetwork:
    """Train the network, in place, and return one with the running mean of its weights.

    Parameters
    ----------
    network
        With Whisper's weights and a readout of them.
    teacher
        Whisper's encoder.
    recordings
        With soft targets.
    seed
        Of excerpts and disturbances.
    num_steps
        Number of batches of 32 s of sound.
    kept
        File that the state of training is written to now and then. If it is there, training goes
        on from it.
    report
        Receives lines of progress.
    """
    averaged = AveragedModel(network, avg_fn=late_mean(_MEAN_EXPONENT))
    optimizer = torch.optim.AdamW(_groups(network), weight_decay=_WEIGHT_DECAY)
    rates = [group["lr"] for group in optimizer.param_groups]
    done = 0
    if kept.exists():
        state = torch.load(kept, weights_only=True)
        done = state["step"]
        network.load_state_dict(state["network"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        report(f"going on after step {done}")
    network.train()
    parts = []
    for step in range(done, num_steps):
        torch.manual_seed(seed + step)
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * min(1.0, (step + 1) / _WARM_UP_STEPS)
        batch = block_batch(recordings, seed, step)
        losses = losses_of(network, teacher, batch)
        weights = torch.tensor([1.0, _HIDDEN_WEIGHT])
        loss = (losses @ weights) @ torch.tensor([1.0, _RIGHT_WEIGHT])
        take_step(loss, optimizer, network, averaged, _MAX_GRADIENT_NORM)
        parts.append(losses.detach().flatten().numpy())
        if (step + 1) % _KEEP_EVERY == 0 or step + 1 == num_steps:
            own, own_hidden, right, right_hidden = np.mean(parts, axis=0)
            parts = []
            report(
                f"step {step + 1}: {own:.3f} nats a frame, {own_hidden:.3f} from the teacher; "
                f"right context {right:.3f} nats, {right_hidden:.3f}"
            )
            state = {
                "step": step + 1,
                "network": network.state_dict(),
                "averaged": averaged.state_dict(),
                "optimizer": optimizer.state_dict(),
            }
            unfinished = kept.with_suffix(".part")
            torch.save(state, unfinished)
            unfinished.replace(kept)
    return cast(BlockNetwork, averaged.module).eval()


def losses_of(network: BlockNetwork, teacher: WholeEncoder, batch: BlockBatch) -> Tensor:
    """Compute a batch's losses, (2, 2): cross-entropy and distance, of own and right positions."""
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
        losses.append(torch.stack([entropy, apart[:, part].square().mean()]))
    return torch.stack(losses)


def _groups(network: BlockNetwork) -> list[dict[str, object]]:
    """Give each layer its rate, and freeze the convolutions."""
    for convolution in (network.encoder.first, network.encoder.second):
        convolution.requires_grad_(False)
    layers = list(network.encoder.layers)
    groups: list[dict[str, object]] = [
        {"params": list(layer.parameters()), "lr": _RATE * _RATE_BELOW ** (len(layers) - 1 - place)}
        for place, layer in enumerate(layers)
    ]
    return [*groups, {"params": list(network.readout.parameters()), "lr": _READOUT_RATE}]
