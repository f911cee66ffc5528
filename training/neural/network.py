"""The neural recognizer's network in PyTorch: a causal transformer encoder.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (Whisper:
the encoder's layers and the initial weights); Vaswani et al. 2017, "Attention is all you need"
(sinusoidal positions). For live use, a position attends only to itself and the ``WINDOW - 1``
positions before it. The teacher (:mod:`kouxing.training.neural.teacher`) runs the same layers on
whole recordings.

======== =========================================================== ============================
symbol   meaning                                                     shape
======== =========================================================== ============================
x        log-mel frames, two of zeros before the first               (batch, frames, 80)
h        hidden positions, every other frame                         (batch, positions, width)
y_d      log posteriors of the states at a position's two frames     (batch, positions, 2, states)
======== =========================================================== ============================

Position ``p`` has seen the frames up to ``2 p + 2``. With a look-ahead of ``d`` frames its output
frames are ``2 p + 2 - d`` and ``2 p + 3 - d``; the second one's look-ahead is a frame shorter. All
look-aheads share the layers, and each has its own output layer.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, log_softmax, scaled_dot_product_attention

from kouxing.services.recognizer.acoustic.network import NUM_INPUTS, WINDOW, position_table

PADDING_FRAMES = 2  # of zeros, before a segment's first


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """Sizes of a network; the defaults are those of Whisper base."""

    num_states: int
    look_aheads: tuple[int, ...]  # feature frames, 1 or more
    width: int = 512
    heads: int = 8
    layers: int = 4
    inner: int = 2048  # width inside a layer's second half


class Layer(nn.Module):
    """Attention, then two linear layers; both parts have residual connections."""

    def __init__(self, shape: Shape, dropout: float) -> None:
        super().__init__()
        self.heads = shape.heads
        self.attention_norm = nn.LayerNorm(shape.width)
        self.query_key_value = nn.Linear(shape.width, 3 * shape.width)
        self.attended = nn.Linear(shape.width, shape.width)
        self.inner_norm = nn.LayerNorm(shape.width)
        self.inner = nn.Linear(shape.width, shape.inner)
        self.outer = nn.Linear(shape.inner, shape.width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, hidden: Tensor, may_attend: Tensor | None = None) -> Tensor:
        """Compute (batch, positions, width) from the same shape.

        ``may_attend`` is a mask, (positions, positions); with None all positions attend to all.
        """
        batch, num_positions, width = hidden.shape
        query, key, value = (
            self.query_key_value(self.attention_norm(hidden))
            .view(batch, num_positions, 3, self.heads, width // self.heads)
            .permute(2, 0, 3, 1, 4)
        )
        attended = scaled_dot_product_attention(query, key, value, attn_mask=may_attend)
        attended = attended.transpose(1, 2).reshape(batch, num_positions, width)
        hidden = hidden + self.dropout(self.attended(attended))
        inner = gelu(self.inner(self.inner_norm(hidden)))
        return hidden + self.dropout(self.outer(inner))


class Encoder(nn.Module):
    """Whisper's encoder: two convolutions, a table of positions, layers.

    ``padding`` is the padding of each convolution's input.
    """

    positions: Tensor  # (1500, width)

    def __init__(self, shape: Shape, *, dropout: float, padding: int) -> None:
        super().__init__()
        self.shape = shape
        self.first = nn.Conv1d(NUM_INPUTS, shape.width, 3, padding=padding)
        self.second = nn.Conv1d(shape.width, shape.width, 3, stride=2, padding=padding)
        self.register_buffer(
            "positions", torch.from_numpy(position_table(shape.width)), persistent=False
        )
        self.layers = nn.ModuleList(Layer(shape, dropout) for _ in range(shape.layers))

    def embed(self, bands: Tensor, start: int = 0) -> Tensor:
        """Compute the first layer's input: (batch, 80, frames) to (batch, positions, width).

        ``start`` is the first position's row in the table.
        """
        hidden = gelu(self.second(gelu(self.first(bands)))).transpose(1, 2)
        return hidden + self.positions[start : start + hidden.shape[1]]


class Network(Encoder):
    """The causal encoder, with an output layer per look-ahead."""

    def __init__(self, shape: Shape, dropout: float = 0.1) -> None:
        super().__init__(shape, dropout=dropout, padding=0)
        self.norm = nn.LayerNorm(shape.width)
        self.outputs = nn.ModuleList(
            nn.Linear(shape.width, 2 * shape.num_states) for _ in shape.look_aheads
        )
        self.dropout = nn.Dropout(dropout)

    def forward(self, frames: Tensor, start: int = 0) -> Tensor:
        """Run the layers on a segment: (batch, frames, 80) to (batch, positions, width).

        There are ``(frames - 1) // 2`` positions; ``start`` is the first one's row in the table.
        """
        padding = frames.new_zeros((len(frames), PADDING_FRAMES, NUM_INPUTS))
        hidden = self.embed(torch.cat([padding, frames], dim=1).transpose(1, 2), start)
        places = torch.arange(hidden.shape[1])
        back = places[:, None] - places
        may_attend = (back >= 0) & (back < WINDOW)
        for layer in self.layers:
            hidden = layer(hidden, may_attend)
        return self.norm(hidden)

    def log_posteriors(self, hidden: Tensor, output: int) -> Tensor:
        """Run an output layer: (batch, positions, width) to (batch, positions, 2, states)."""
        batch, num_positions, _ = hidden.shape
        logits = self.outputs[output](self.dropout(hidden)).float()
        return log_softmax(logits.view(batch, num_positions, 2, -1), dim=-1)


def mixed_precision() -> torch.autocast:
    """Use bfloat16 products if the processor supports them."""
    faster = torch.cpu.get_capabilities().get("avx512_bf16", False)
    return torch.autocast("cpu", torch.bfloat16, enabled=faster)


def output_frames(num_positions: int, look_ahead_frames: int) -> Tensor:
    """Return the numbers of each position's two output frames, (positions, 2)."""
    first = 2 * torch.arange(num_positions) + 2 - look_ahead_frames
    return torch.stack([first, first + 1], dim=1)
