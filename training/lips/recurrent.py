"""The recurrent half of the lip model, and each speaker's units.

A tracked face's neutral position is never exactly its rest position, and an animator's rig has
other extents. The network therefore predicts a canonical face. Each speaker's scale and offset are
learned with it, and regularized toward 1 and 0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from kouxing.services.recognizer.lips.lip_predictor import NUM_LIP_FAPS, NUM_OUTPUTS
from kouxing.shared.arrays import Floats

HIDDEN_WIDTH = 96
_DROPOUT = 0.3
_INPUT_NOISE = 0.1  # standard deviation; a component has 1
_PIECE = 200  # positions
_MIN_PIECE = 10
_BATCH = 32  # pieces
_LEARNING_RATE, _WEIGHT_DECAY = 2e-3, 1e-2
_PROBABILITY_WEIGHT = 0.3  # weight of closure and lip to teeth in the loss
_UNITS_WEIGHT = 0.01  # weight of a speaker's squared scale (log) and offset
_MAX_GRADIENT = 1.0


class LipNetwork(nn.Module):
    """A gated recurrent unit after a rectified linear layer; the teacher's runs both ways."""

    def __init__(
        self, num_components: int, num_delays: int, num_speakers: int, *, both_ways: bool = False
    ) -> None:
        super().__init__()
        self.shape = (num_delays, NUM_OUTPUTS)
        self.entry = nn.Linear(num_components, HIDDEN_WIDTH)
        self.recurrent = nn.GRU(
            HIDDEN_WIDTH, HIDDEN_WIDTH, batch_first=True, bidirectional=both_ways
        )
        self.output = nn.Linear((3 if both_ways else 2) * HIDDEN_WIDTH, num_delays * NUM_OUTPUTS)
        self.dropout = nn.Dropout(_DROPOUT)
        self.log_scale = nn.Parameter(torch.zeros(num_speakers, NUM_LIP_FAPS))
        self.offset = nn.Parameter(torch.zeros(num_speakers, NUM_LIP_FAPS))

    def forward(self, components: Tensor) -> Tensor:
        """Compute the outputs in canonical units, (batch, positions, delays, 17)."""
        entered = torch.relu(self.entry(self.dropout(components)))
        states, _ = self.recurrent(self.dropout(entered))
        outputs: Tensor = self.output(self.dropout(torch.cat([states, entered], dim=-1)))
        return outputs.view(*components.shape[:2], *self.shape)

    def loss(self, components: Tensor, targets: Tensor, speakers: Tensor) -> Tensor:
        """Compute the mean loss of a batch; targets that are NaN are ignored."""
        noise = _INPUT_NOISE * torch.randn_like(components)
        outputs = self(components + noise)
        scale = torch.exp(self.log_scale[speakers])[:, None, None]
        offset = self.offset[speakers][:, None, None]
        wanted = torch.nan_to_num(targets)
        known = ~torch.isnan(targets)
        error = (outputs[..., :NUM_LIP_FAPS] * scale + offset - wanted[..., :NUM_LIP_FAPS]) ** 2
        total = _mean(error, known[..., :NUM_LIP_FAPS])
        for column in range(NUM_LIP_FAPS, NUM_OUTPUTS):
            entropy = binary_cross_entropy_with_logits(
                outputs[..., column], wanted[..., column], reduction="none"
            )
            total = total + _PROBABILITY_WEIGHT * _mean(entropy, known[..., column])
        squares = (self.log_scale**2).mean() + (self.offset**2).mean()
        return total + _UNITS_WEIGHT * len(self.offset) * squares


@dataclass(frozen=True, slots=True)
class SpeechExample:
    """A stretch of speech with its targets."""

    components: NDArray[np.floating]  # (positions, components)
    targets: NDArray[np.floating]  # (positions, delays, 17), FAPs standardized
    speaker: int


def train_network(
    examples: Sequence[SpeechExample], *, num_epochs: int, seed: int, both_ways: bool = False
) -> tuple[LipNetwork, list[float]]:
    """Train; return the network and the mean loss of each epoch.

    ``both_ways`` makes the recurrent layer bidirectional.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    pieces = _cut(examples)
    first = pieces[0]
    network = LipNetwork(
        first.components.shape[1],
        first.targets.shape[1],
        1 + max(example.speaker for example in examples),
        both_ways=both_ways,
    )
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY
    )
    num_batches = math.ceil(len(pieces) / _BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, _LEARNING_RATE, total_steps=num_batches * num_epochs
    )
    losses = []
    network.train()
    for _ in range(num_epochs):
        total = 0.0
        # Pieces of similar length share a batch.
        lengths = [len(piece.components) // 40 + rng.random() for piece in pieces]
        batches = np.array_split(np.argsort(lengths), num_batches)
        for number in rng.permutation(num_batches):
            optimizer.zero_grad()
            loss = network.loss(*_batch([pieces[k] for k in batches[number]]))
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), _MAX_GRADIENT)
            optimizer.step()
            schedule.step()
            total += float(loss.detach())
        losses.append(total / num_batches)
    return network.eval(), losses


def _cut(examples: Sequence[SpeechExample]) -> list[SpeechExample]:
    return [
        SpeechExample(whole.components[start:end], whole.targets[start:end], whole.speaker)
        for whole in examples
        for start in range(0, len(whole.components), _PIECE)
        if (end := min(start + _PIECE, len(whole.components))) - start >= _MIN_PIECE
    ]


def _batch(pieces: Sequence[SpeechExample]) -> tuple[Tensor, Tensor, Tensor]:
    """Stack pieces, padded at their ends: components, targets, speakers."""
    longest = max(len(piece.components) for piece in pieces)

    def padded(rows: NDArray[np.floating], value: float) -> Floats:
        more = [(0, longest - len(rows)), *[(0, 0)] * (rows.ndim - 1)]
        return np.pad(rows.astype(np.float32), more, constant_values=value)

    components = np.stack([padded(piece.components, 0.0) for piece in pieces])
    targets = np.stack([padded(piece.targets, np.nan) for piece in pieces])
    speakers = torch.tensor([piece.speaker for piece in pieces])
    return torch.from_numpy(components), torch.from_numpy(targets), speakers


def _mean(values: Tensor, known: Tensor) -> Tensor:
    return torch.where(known, values, torch.zeros(())).sum() / (known.sum() + 1)
