"""The recurrent network of the neural recognizer, in PyTorch.

Sources: Cho et al. 2014, "Learning phrase representations using RNN encoder-decoder" (gated
recurrent units); Sak et al. 2015, "Fast and accurate recurrent neural network acoustic models for
speech recognition" (targets delayed against the input instead of future input).

======== =========================================================== ====================
symbol   meaning                                                     shape
======== =========================================================== ====================
x        normalised log energy and log-mel bands                     (batch, frames, 41)
h        outputs of both recurrent layers                            (batch, frames, 2 H)
y_d      log share of each state at frame t - d, known at frame t    (batch, frames, states)
======== =========================================================== ====================

One trunk serves every look-ahead d: each has an output layer of its own. The trunk sees nothing
but the past and the present, so its delay is that of the output layer in use. The second task,
phones of another language, has as many outputs, of which it uses some.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from services.recognizer.features import NUM_BANDS

NUM_INPUTS = 1 + NUM_BANDS
FRONT_FRAMES = 5  # that the first layer sees: the present and four before it


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """Sizes of a network."""

    num_states: int
    look_aheads: tuple[int, ...]  # feature frames
    front: int = 256  # width of the convolution
    hidden: int = 256  # H, of each recurrent layer


class Network(nn.Module):
    """Convolution over the last frames, two recurrent layers, an output layer per look-ahead."""

    def __init__(self, shape: Shape, dropout: float = 0.15) -> None:
        super().__init__()
        self.shape = shape
        self.front = nn.Conv1d(NUM_INPUTS, shape.front, FRONT_FRAMES)
        self.first = nn.GRU(shape.front, shape.hidden, batch_first=True)
        self.second = nn.GRU(shape.hidden, shape.hidden, batch_first=True)
        self.heads = nn.ModuleList(
            nn.Linear(2 * shape.hidden, shape.num_states) for _ in shape.look_aheads
        )
        self.second_task = nn.Linear(2 * shape.hidden, shape.num_states)
        self.dropout = nn.Dropout(dropout)

    def forward(self, frames: Tensor) -> Tensor:
        """Run the trunk from rest: (batch, frames, 41) to (batch, frames, 2 H).

        Before the first frame stands that frame again.
        """
        past = frames[:, :1].expand(-1, FRONT_FRAMES - 1, -1)
        seen = torch.cat([past, frames], dim=1).transpose(1, 2)
        front = torch.relu(self.front(seen)).transpose(1, 2)
        first, _ = self.first(self.dropout(front))
        second, _ = self.second(self.dropout(first))
        hidden: Tensor = self.dropout(torch.cat([first, second], dim=-1))
        return hidden
