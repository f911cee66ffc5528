"""The training loop of the audio encoder, for its first training and its refinement."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from kouxing.corpora.parallel import process_in_order
from kouxing.training.device import DEVICE, mixed_precision
from kouxing.training.encoder.network import AudioEncoder
from kouxing.training.networks.optimizer import optimize


def train_on_batches(
    encoder: AudioEncoder,
    draw: Callable[[int], Sequence[NDArray[Any]]],
    loss: Callable[..., Tensor],
    *,
    learning_rate: float,
    warm_up_steps: int,
    decay_fraction: float,
    num_steps: int,
    checkpoint: Path,
) -> AudioEncoder:
    """Train an encoder, which is on the device; return one with the running mean of its weights.

    ``draw`` draws a batch by its number, and ``loss`` computes its loss from the same arrays as
    tensors. Training resumes from ``checkpoint``.
    """
    batches: Iterator[Sequence[NDArray[Any]]] | None = None

    def losses(step: int) -> Iterator[Tensor]:
        nonlocal batches
        if batches is None:
            batches = process_in_order(draw, range(step, num_steps))
        with mixed_precision():
            part = loss(*(torch.from_numpy(array).to(DEVICE).float() for array in next(batches)))
        yield part

    return optimize(
        encoder,
        [{"params": list(encoder.parameters()), "lr": learning_rate}],
        losses,
        num_steps=num_steps,
        warm_up_steps=warm_up_steps,
        decay_fraction=decay_fraction,
        max_norm=1.0,
        checkpoint=checkpoint,
    ).cpu()
