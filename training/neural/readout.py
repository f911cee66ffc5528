"""A recurrent readout of states from the positions of Whisper's encoder.

Sources: Cho et al. 2014, "Learning phrase representations using RNN encoder-decoder for statistical
machine translation" (the GRU); Schuster and Paliwal 1997, "Bidirectional recurrent neural
networks".

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

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, log_softmax

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
    num_masks: int = 0  # of positions; each is used with a probability of 1/2


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
        """Set mean and deviation to those of features, (n, features)."""
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
        return self.dropout(gelu(self.inner(standard)))

    def log_posteriors(self, context: Tensor, inner: Tensor) -> Tensor:
        """Compute the output: (batch, positions, ...) to (batch, 2 positions, states)."""
        logits = self.output(self.dropout(torch.cat([context, inner], dim=-1)))
        return log_softmax(logits.unflatten(-1, (2, -1)).flatten(1, 2), dim=-1)

    def _add_noise(self, standard: Tensor) -> Tensor:
        """Add noise to features, (batch, positions, features); mask some features and positions."""
        batch, num_positions, num_features = standard.shape
        noisy = standard + self.shape.noise * torch.randn_like(standard)
        if self.shape.constant_noise:
            amount = self.shape.constant_noise * torch.rand(batch, 1, 1)
            noisy = noisy + amount * torch.randn(batch, 1, num_features)
        if self.shape.feature_dropout:
            noisy = noisy * (torch.rand(batch, 1, num_features) >= self.shape.feature_dropout)
        position = torch.arange(num_positions)[:, None]
        for _ in range(self.shape.num_masks):
            first = torch.randint(num_positions, (batch, 1, 1))
            width = torch.randint(1, _MAX_MASKED + 1, (batch, 1, 1))
            is_used = torch.rand(batch, 1, 1) < 0.5
            noisy = noisy * ~(is_used & (position >= first) & (position < first + width))
        return noisy
