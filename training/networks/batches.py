"""Batches of augmented recordings with the targets of their frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from kouxing.shared.arrays import Doubles, Float16, Int16, Integers


@dataclass(frozen=True, slots=True)
class FrameTargets:
    """Target distribution of each frame: its likeliest states with their probabilities."""

    states: NDArray[np.uint16]  # (frames, k)
    probs: Float16  # (frames, k) sum to 1, or to 0 where no target is known

    def __len__(self) -> int:
        return len(self.states)

    @classmethod
    def hard(cls, states: NDArray[np.integer[Any]]) -> FrameTargets:
        """Make targets of one state a frame, shape (frames,)."""
        return cls(states[:, None].astype(np.uint16), np.ones((len(states), 1), np.float16))

    def select(self, frames: Integers | slice) -> FrameTargets:
        """Select the targets of some frames."""
        return FrameTargets(self.states[frames], self.probs[frames])

    def average_with(self, other: FrameTargets) -> FrameTargets:
        """Average with other targets of the same frames."""
        return FrameTargets(
            np.hstack([self.states, other.states]),
            np.hstack([self.probs, other.probs]) * np.float16(0.5),
        )

    def pad_states(self, width: int) -> FrameTargets:
        """Add states with the probability 0, up to this number a frame."""
        added = (0, 0), (0, width - self.states.shape[1])
        return FrameTargets(np.pad(self.states, added), np.pad(self.probs, added))


@dataclass(frozen=True, slots=True, kw_only=True)
class LabeledRecording:
    """A recording with its targets."""

    samples: Int16  # (n,) 16 kHz
    targets: FrameTargets  # targets of its frames
    weight: float  # relative to the others', how often it is sampled


Sample = tuple[NDArray[np.floating[Any]], FrameTargets]  # inputs of the network, (rows, inputs)
Batch = tuple[Tensor, Tensor, Tensor]  # inputs; states and probabilities, (batch, frames, k)


def sampling_probs(recordings: Sequence[LabeledRecording]) -> Doubles:
    """Probabilities of sampling each recording, (recordings,)."""
    weights = np.array([recording.weight for recording in recordings])
    weights /= weights.sum()
    return weights


def padded_batch(group: Sequence[Sample]) -> Batch:
    """Make a batch; short samples repeat their last row, without targets.

    All targets have equally many states a frame.
    """
    num_rows = max(len(rows) for rows, _ in group)
    inputs = [np.pad(rows, ((0, num_rows - len(rows)), (0, 0)), "edge") for rows, _ in group]
    states = [torch.from_numpy(targets.states.astype(np.int64)) for _, targets in group]
    probs = [torch.from_numpy(targets.probs.astype(np.float32)) for _, targets in group]
    return (
        torch.from_numpy(np.stack(inputs).astype(np.float32)),
        pad_sequence(states, batch_first=True),
        pad_sequence(probs, batch_first=True),
    )
