"""Trains the universal readout on stored features.

The readout is defined in :mod:`kouxing.training.blocks.network`. Its loss is the
cross-entropy with the aligned states, of a block's own positions and, with half the weight, of its
right context. The encoder is not trained.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import nll_loss

from kouxing.shared.arrays import Integers
from kouxing.training.blocks.network import BlockLayout, BlockReadout, block_layout
from kouxing.training.networks.network import ReadoutShape
from kouxing.training.networks.optimizer import optimize
from kouxing.training.seed import SEED
from kouxing.training.universal.encoder import BLOCK_LENGTH, LENGTH, RIGHT_CONTEXT
from kouxing.training.universal.features import STEP, WIDTH, Features

READOUT = ReadoutShape(
    inner=288,
    gru=160,
    dropout=0.15,
    noise=0.15,
    constant_noise=0.2,
    feature_dropout=0.05,
    num_masks=1,
)
_NUM_CROPS, _CROP_BLOCKS = 8, 12  # in a batch, in a crop
_CROP_POSITIONS = _CROP_BLOCKS * BLOCK_LENGTH
CROPS_S = _NUM_CROPS * _CROP_POSITIONS * 0.02
_LEARNING_RATE, _WARM_UP_STEPS, _DECAY_FRACTION = 2e-3, 40, 0.6
_RIGHT_WEIGHT = 0.5
_NO_STATE = -1


def train_readout(
    readout: BlockReadout,
    recordings: Sequence[Features],
    states: Mapping[str, Integers],
    weights: Sequence[float],
    *,
    num_steps: int,
    checkpoint: Path,
) -> BlockReadout:
    """Train a readout; return one with the running mean of its weights.

    ``states`` are the states of each recording's frames, by its name. ``weights`` are the relative
    sampling weights of the recordings.
    """
    probs = np.cumsum(weights) / np.sum(weights)
    layout = block_layout(_CROP_POSITIONS, BLOCK_LENGTH, RIGHT_CONTEXT)
    readout.train()

    def losses(step: int) -> Iterator[Tensor]:
        rng = np.random.default_rng([SEED, step])
        drawn = [recordings[int(np.searchsorted(probs, rng.random()))] for _ in range(_NUM_CROPS)]
        crops = [_crop(recording, states[recording.name], layout, rng) for recording in drawn]
        features, targets = (torch.from_numpy(np.stack(part)) for part in zip(*crops, strict=True))
        with torch.autocast("cpu", torch.bfloat16):
            log_posteriors = readout.read(features.float() * STEP, layout).float()
        own, right = (
            nll_loss(
                log_posteriors[:, part].flatten(0, 2),
                targets[:, part].flatten(),
                ignore_index=_NO_STATE,
            )
            for part in (slice(_CROP_POSITIONS), slice(_CROP_POSITIONS, None))
        )
        yield own + _RIGHT_WEIGHT * right

    return optimize(
        readout,
        [{"params": list(readout.parameters()), "lr": _LEARNING_RATE}],
        losses,
        num_steps=num_steps,
        warm_up_steps=_WARM_UP_STEPS,
        decay_fraction=_DECAY_FRACTION,
        checkpoint=checkpoint,
    )


def _crop(
    recording: Features, states: Integers, layout: BlockLayout, rng: np.random.Generator
) -> tuple[NDArray[np.int8], Integers]:
    """Draw blocks of a recording; return features, (n, 1024), and states, (n, 2)."""
    num_more = len(recording.rows) - _CROP_BLOCKS
    first = int(rng.integers(num_more + 1)) if num_more > 0 and rng.random() < 0.5 else 0
    rows = np.zeros((_CROP_BLOCKS, LENGTH, WIDTH), np.int8)
    crop = recording.rows[first : first + _CROP_BLOCKS]
    rows[: len(crop)] = crop
    targets = np.full(2 * _CROP_POSITIONS, _NO_STATE)
    kept = states[2 * BLOCK_LENGTH * first :][: len(targets)]
    targets[: len(kept)] = kept
    by_place = targets.reshape(-1, 2)[layout.places.numpy()]
    return rows.reshape(-1, WIDTH)[_in_cache(layout)], by_place


def _in_cache(layout: BlockLayout) -> Integers:
    """Return the row of each place in the stored blocks, (n,)."""
    own = np.arange(layout.num_positions)
    rows = own // BLOCK_LENGTH * LENGTH + own % BLOCK_LENGTH
    copied = (layout.blocks >= layout.num_positions).numpy().flatten().nonzero()[0]
    return np.concatenate([rows, copied])
