"""The networks in PyTorch: Whisper's encoder, and a recurrent readout of states.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (Whisper:
the encoder's layers and the initial weights); Vaswani et al. 2017, "Attention is all you need"
(sinusoidal positions). The teacher (:mod:`kouxing.training.networks.teacher`) runs the encoder on
whole recordings, the block network (:mod:`kouxing.training.blocks.network`) on blocks.

The readout computes states from the positions of Whisper's encoder. Sources: Cho et al. 2014,
"Learning phrase representations using RNN encoder-decoder for statistical machine translation" (the
GRU); Schuster and Paliwal 1997, "Bidirectional recurrent neural networks".

    z = clip((concat(h_4, h_5, h_6) - mean) / deviation, -6, 6)
    a = gelu(W z)
    y = log softmax(V concat(GRU(a), a))

========== ========================================================== ======================
symbol     meaning                                                    shape
========== ========================================================== ======================
h_l        positions after layer l                                    (positions, width)
mean,      of the features in the training data                       (3 width,)
deviation
a          input of the GRU, which is bidirectional                   (positions, inner)
y          log posteriors of the states at two frames                 (positions, 2, states)
========== ========================================================== ======================
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, log_softmax, scaled_dot_product_attention

from kouxing.services.recognizer.acoustic.network import position_table
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS

PADDING_FRAMES = 2  # zeros before a segment's first frame


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderShape:
    """Sizes of a network; the defaults match Whisper base."""

    width: int = 512
    heads: int = 8
    layers: int = 4
    inner: int = 2048  # width inside a layer's second half


class EncoderLayer(nn.Module):
    """Attention, then two linear layers; both parts have residual connections."""

    def __init__(self, shape: EncoderShape, dropout: float) -> None:
        super().__init__()
        self.heads = shape.heads
        self.attention_norm = nn.LayerNorm(shape.width)
        self.query_key_value = nn.Linear(shape.width, 3 * shape.width)
        self.attended = nn.Linear(shape.width, shape.width)
        self.inner_norm = nn.LayerNorm(shape.width)
        self.inner = nn.Linear(shape.width, shape.inner)
        self.outer = nn.Linear(shape.inner, shape.width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, hidden: Tensor, attention_mask: Tensor | None = None) -> Tensor:
        """Compute (batch, positions, width) from the same shape.

        ``attention_mask`` is a mask, (positions, positions); with None all positions attend to all.
        """
        batch, num_positions, width = hidden.shape
        query, key, value = (
            self.query_key_value(self.attention_norm(hidden))
            .view(batch, num_positions, 3, self.heads, width // self.heads)
            .permute(2, 0, 3, 1, 4)
        )
        attended = scaled_dot_product_attention(query, key, value, attn_mask=attention_mask)
        attended = attended.transpose(1, 2).reshape(batch, num_positions, width)
        hidden = hidden + self.dropout(self.attended(attended))
        inner = gelu(self.inner(self.inner_norm(hidden)))
        result: Tensor = hidden + self.dropout(self.outer(inner))
        return result


class Encoder(nn.Module):
    """Whisper's encoder: two convolutions, a table of positions, layers.

    ``padding`` is the padding of each convolution's input.
    """

    positions: Tensor  # (1500, width)

    def __init__(self, shape: EncoderShape, *, dropout: float, padding: int) -> None:
        super().__init__()
        self.shape = shape
        self.first = nn.Conv1d(NUM_MELS, shape.width, 3, padding=padding)
        self.second = nn.Conv1d(shape.width, shape.width, 3, stride=2, padding=padding)
        self.register_buffer(
            "positions", torch.from_numpy(position_table(shape.width)), persistent=False
        )
        self.layers = nn.ModuleList(EncoderLayer(shape, dropout) for _ in range(shape.layers))

    def embed(self, bands: Tensor, start: int) -> Tensor:
        """Compute the first layer's input: (batch, 80, frames) to (batch, positions, width).

        ``start`` is the first position's row in the table.
        """
        hidden = gelu(self.second(gelu(self.first(bands)))).transpose(1, 2)
        return hidden + self.positions[start : start + hidden.shape[1]]


MAX_DEVIATIONS = 6.0
_MAX_MASKED = 7  # positions


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadoutShape:
    """Widths and regularization of a readout."""

    inner: int
    gru: int
    dropout: float
    noise: float  # added to each feature in training, deviations
    constant_noise: float = 0.0  # upper limit of noise that is constant in a recording
    feature_dropout: float = 0.0  # fraction of the features that are 0 in a whole recording
    num_masks: int = 0  # masked ranges of positions; each is used with a probability of 1/2


class Readout(nn.Module):
    """Computes the posteriors of the states of two frames from each position's features."""

    mean: Tensor  # (features,)
    deviation: Tensor  # (features,)

    def __init__(self, num_features: int, num_states: int, shape: ReadoutShape) -> None:
        super().__init__()
        self.shape = shape
        self.register_buffer("mean", torch.zeros(num_features))
        self.register_buffer("deviation", torch.ones(num_features))
        self.inner = nn.Linear(num_features, shape.inner)
        self.gru = nn.GRU(shape.inner, shape.gru, batch_first=True, bidirectional=True)
        self.output = nn.Linear(2 * shape.gru + shape.inner, 2 * num_states)
        self.dropout = nn.Dropout(shape.dropout)

    def standardize(self, features: Tensor) -> None:
        """Set mean and deviation from features, (n, features)."""
        self.mean[:] = features.mean(dim=0)
        self.deviation[:] = features.std(dim=0) + 1e-3

    def forward(self, features: Tensor) -> Tensor:
        """Compute log posteriors: (batch, positions, features) to (batch, 2 positions, states)."""
        inner = self.inner_of(features)
        context, _ = self.gru(inner)
        return self.log_posteriors(context, inner)

    def inner_of(self, features: Tensor) -> Tensor:
        """Compute the recurrent layer's input: (batch, positions, features) to (..., inner)."""
        standard = (features - self.mean) / self.deviation
        standard = standard.clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
        if self.training:
            standard = self._add_noise(standard)
        result: Tensor = self.dropout(gelu(self.inner(standard)))
        return result

    def log_posteriors(self, context: Tensor, inner: Tensor) -> Tensor:
        """Compute the output: (batch, positions, ...) to (batch, 2 positions, states)."""
        logits = self.output(self.dropout(torch.cat([context, inner], dim=-1)))
        return log_softmax(logits.unflatten(-1, (2, -1)).flatten(1, 2), dim=-1)

    def _add_noise(self, standard: Tensor) -> Tensor:
        """Add noise to features, (batch, positions, features); mask some features and positions."""
        batch, num_positions, num_features = standard.shape
        device = standard.device
        noisy = standard + self.shape.noise * torch.randn_like(standard)
        if self.shape.constant_noise:
            amount = self.shape.constant_noise * torch.rand(batch, 1, 1, device=device)
            noisy = noisy + amount * torch.randn(batch, 1, num_features, device=device)
        if self.shape.feature_dropout:
            mask = torch.rand(batch, 1, num_features, device=device) >= self.shape.feature_dropout
            noisy = noisy * mask
        position = torch.arange(num_positions, device=device)[:, None]
        for _ in range(self.shape.num_masks):
            first = torch.randint(num_positions, (batch, 1, 1), device=device)
            width = torch.randint(1, _MAX_MASKED + 1, (batch, 1, 1), device=device)
            is_used = torch.rand(batch, 1, 1, device=device) < 0.5
            noisy = noisy * ~(is_used & (position >= first) & (position < first + width))
        return noisy
