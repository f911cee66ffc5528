"""The block recognizer's network, in PyTorch: Whisper's encoder in blocks, and its readout.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
encoder's layers, and the weights that training starts with); Shi et al. 2021, "Emformer: efficient
memory transformer based acoustic model for low latency streaming speech recognition" (blocks with
a cached past and hard copies of their right context); Zhang et al. 2016, "Highway long short-term
memory RNNs for distant speech recognition" (a recurrent layer whose backward direction begins a
few positions after its block); Cho et al. 2014, "Learning phrase representations using RNN
encoder-decoder for statistical machine translation" (the GRU).

A recording's positions form blocks of ``B``. A block and the ``R`` positions after it, its right
context, attend to each other and to the ``PAST`` positions before the block, in all layers. Live, a
block is computed together with its right context. Keys and values of the block's own positions are
cached. The right context is computed again as a part of later blocks.

For training, all blocks of a recording are computed at once: first its positions, then a copy of
each block's right context, with an attention mask. Both ways give the same results. Outputs of a
block's own positions are final, and its right context is provisional. The network does not depend
on ``B``, so live use may choose another ``B`` than training.

    z = clip((concat(h_4, h_5, h_6) - mean) / deviation, -6, 6)
    a = gelu(W z)
    y = log softmax(V concat(forward GRU(a), backward GRU(a), a))

======== ================================================================ =====================
symbol   meaning                                                          shape
======== ================================================================ =====================
x        log-mel frames; two frames of zeros precede the first            (batch, frames, 80)
h_l      positions after layer l                                          (batch, n, width)
R        right context, positions; a recording's last blocks have less    1
n        positions, and copies of right contexts                          1
a        input of the recurrent layer. It runs forward over all blocks    (batch, n, 320)
         and, from a block's end, over its right context. It runs
         backward over the right context and then the block.
y        log posteriors of the states at the frames 2 p and 2 p + 1       (batch, n, 2, states)
         of position p
======== ================================================================ =====================

Position ``p`` has seen the frames up to ``2 p + 2``, so a block that starts at position ``p`` needs
the frames up to ``2 (p + B + R)``. Bands are floored at eight decades below the loudest one so far.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import pad

from kouxing.services.recognizer.front_end.whisper_mel import FLOOR_BANDS
from kouxing.training.networks.network import (
    PADDING_FRAMES,
    Encoder,
    EncoderShape,
    Readout,
    ReadoutShape,
)
from kouxing.training.networks.teacher import KEPT_LAYERS

RIGHT_CONTEXT = 10  # positions, 200 ms
PAST = 125  # positions before a block that it attends to, 2.5 s

READOUT = ReadoutShape(inner=320, gru=192, dropout=0.2, noise=0.15)
_CPU = torch.device("cpu")
_GRU_WEIGHTS = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")


@dataclass(frozen=True, slots=True)
class BlockLayout:
    """The positions that are computed for a recording, and their attention mask."""

    num_positions: int  # number of positions in the recording
    places: Tensor  # (n,) in the recording: all positions, then each block's right context
    attention_mask: Tensor  # (n, n)
    blocks: Tensor  # (blocks, B + R), the positions of a block and its right context, of n
    is_valid: Tensor  # (blocks, B + R)
    block_indices: Tensor  # (n,), places in the flattened blocks
    right_indices: Tensor  # (copies,), places in the flattened right contexts
    block_length: int  # B

    def in_order(self, by_block: Tensor) -> Tensor:
        """Put values of the blocks, (batch, blocks, B + R, width), in order: (batch, n, width)."""
        return by_block.flatten(1, 2)[:, self.block_indices]


@cache
def block_layout(
    num_positions: int,
    block_length: int,
    right_context: int = RIGHT_CONTEXT,
    device: torch.device = _CPU,
) -> BlockLayout:
    """Lay out a recording's positions and right contexts."""
    num_blocks = math.ceil(num_positions / block_length)
    begins = block_length * torch.arange(num_blocks)
    places = begins[:, None] + torch.arange(block_length + right_context)
    is_valid = places < num_positions
    copied = is_valid.clone()
    copied[:, :block_length] = False
    blocks = places.clone()
    blocks[copied] = num_positions + torch.arange(int(copied.sum()))
    blocks[~is_valid] = 0
    positions = torch.arange(num_positions)
    block_of = torch.cat([positions // block_length, copied.nonzero()[:, 0]])
    begin = begins[block_of][:, None]  # start of the attending position's block
    attention_mask = block_of == block_of[:, None]
    attention_mask[:, :num_positions] |= (positions < begin) & (positions >= begin - PAST)
    is_block_row = is_valid & ~copied
    block_indices = torch.cat([part.flatten().nonzero()[:, 0] for part in (is_block_row, copied)])
    return BlockLayout(
        num_positions=num_positions,
        places=torch.cat([positions, places[copied]]).to(device),
        attention_mask=attention_mask.to(device),
        blocks=blocks.to(device),
        is_valid=is_valid.to(device),
        block_indices=block_indices.to(device),
        right_indices=copied[:, block_length:].flatten().nonzero()[:, 0].to(device),
        block_length=block_length,
    )


class BlockEncoder(Encoder):
    """Whisper's encoder in blocks."""

    def __init__(self, shape: EncoderShape) -> None:
        super().__init__(shape, dropout=0.0, padding=0)

    def forward(self, frames: Tensor, layout: BlockLayout, start: int = 0) -> Tensor:
        """Run the layers: (batch, frames, 80) to the kept layers, (batch, n, 3 width).

        There are ``2 positions + 1`` frames; ``start`` is the first position's row in the table.
        """
        loudest = frames.amax(dim=2, keepdim=True).cummax(dim=1).values
        bands = pad(torch.maximum(frames, loudest - FLOOR_BANDS), (0, 0, PADDING_FRAMES, 0))
        hidden = self.embed(bands.transpose(1, 2), start)[:, layout.places]
        after = []
        for layer in self.layers:
            hidden = layer(hidden, layout.attention_mask)
            after.append(hidden)
        return torch.cat([after[place] for place in KEPT_LAYERS], dim=-1)


class BlockReadout(Readout):
    """A readout whose backward direction restarts in each block."""

    def read(self, features: Tensor, layout: BlockLayout) -> Tensor:
        """Compute log posteriors: (batch, n, features) to (batch, n, 2, states)."""
        inner = self.inner_of(features)
        block_inputs = inner[:, layout.blocks]
        forward_states = self._forward_states(
            inner[:, : layout.num_positions], block_inputs, layout
        )
        context = torch.cat([forward_states, self._backward_states(block_inputs, layout)], dim=-1)
        return self.log_posteriors(context, inner).view(*features.shape[:2], 2, -1)

    def _forward_states(self, inner: Tensor, block_inputs: Tensor, layout: BlockLayout) -> Tensor:
        outputs = self._run(inner, inner.new_zeros(len(inner), self.gru.hidden_size))
        last = layout.blocks[:, : layout.block_length].amax(dim=1)
        right = block_inputs[:, :, layout.block_length :]
        after = self._run(right.flatten(0, 1), outputs[:, last].flatten(0, 1).contiguous())
        right_outputs = after.reshape(len(inner), -1, after.shape[-1])[:, layout.right_indices]
        return torch.cat([outputs, right_outputs], dim=1)

    def _run(self, inputs: Tensor, state: Tensor) -> Tensor:
        weights = [getattr(self.gru, f"{kind}_l0") for kind in _GRU_WEIGHTS]
        # with biases, one layer, no dropout, one direction, batch first
        outputs, _ = torch.gru(
            inputs, state[None], weights, True, 1, 0.0, self.training, False, True
        )
        return outputs

    def _backward_states(self, block_inputs: Tensor, layout: BlockLayout) -> Tensor:
        """Run backward over each right context and its block: (batch, n, width)."""
        weights = [getattr(self.gru, f"{kind}_l0_reverse") for kind in _GRU_WEIGHTS]
        state = block_inputs.new_zeros(
            block_inputs[:, :, 0].numel() // block_inputs.shape[-1], self.gru.hidden_size
        )
        states = []
        for column in reversed(range(block_inputs.shape[2])):
            state = torch.gru_cell(block_inputs[:, :, column].flatten(0, 1), state, *weights)
            state = state * layout.is_valid[:, column].repeat(len(block_inputs))[:, None]
            states.append(state)
        steps = torch.stack(states[::-1], dim=1)
        return layout.in_order(steps.view(*block_inputs.shape[:3], -1))
