"""The audio encoder in PyTorch: a recurrent network of 2.7 million weights, one step every 20 ms.

    a = relu(U x)
    h1 = GRU(a),  h2 = GRU(h1)
    y = V (h1 + h2)

======== ================================================================== ==================
symbol   meaning                                                            shape
======== ================================================================== ==================
x        two log-mel frames, 2 p + 1 and 2 p + 2, of position p             (160,)
y        early components of Whisper's encoder at position p; lips at three (outputs,)
         delays; at position p - 2: late components, phones and voice
         classes (logits), voicing (logit), pitch, level, effort
======== ================================================================== ==================

A step uses audio up to 65 ms after the middle of position p - 2.

    loss = E(early) + E(late) + 3 E(lips) + H(phones) / 2 + H(voice) + H(voicing) / 3
           + |pitch| + E(level) / 5 + E(effort) / 5

E is a mean squared error and H a cross-entropy. Pitch errors are in octaves. Unknown targets are
NaN and are ignored.

Sources: Cho et al. 2014, "Learning phrase representations using RNN encoder-decoder for statistical
machine translation" (the GRU); Romero et al. 2015, "FitNets: hints for thin deep nets" (hidden
layers as targets).
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, log_softmax

from kouxing.services.recognizer.acoustic.encoder import LIP_DELAYS_S, VoiceKind
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.services.recognizer.lips.lip_predictor import NUM_OUTPUTS
from kouxing.shared.arrays import Floats
from kouxing.training.encoder.targets import (
    EFFORT,
    LEVEL,
    NUM_COMPONENTS,
    PITCH,
    VOICE,
    TargetColumns,
)

NUM_INPUTS = 2 * NUM_MELS
LOOK_AHEAD = 2  # positions, of all outputs but the early components and the lips
WIDTH = 448
NUM_LIPS = len(LIP_DELAYS_S) * NUM_OUTPUTS
NUM_FEATURES = 2 * NUM_COMPONENTS + NUM_LIPS  # the first outputs

LIPS_WEIGHT = 3.0
PHONES_WEIGHT, VOICING_WEIGHT, SCALAR_WEIGHT = 1 / 2, 1 / 3, 1 / 5


@dataclass(frozen=True, slots=True)
class OutputParts:
    """The parts of an output row."""

    early: Tensor  # (..., 128)
    late: Tensor  # (..., 128)
    lips: Tensor  # (..., 51)
    phones: Tensor  # (..., phones) logits
    voice: Tensor  # (..., 4) logits
    voicing: Tensor  # (...,) logit
    pitch: Tensor  # (...,) log2 of Hz, relative to `MEAN_PITCH`
    level: Tensor  # (...,)
    effort: Tensor  # (...,)


MEAN_PITCH = 7.5  # log2 of Hz


class AudioEncoder(nn.Module):
    """The network."""

    def __init__(self, num_phones: int, width: int = WIDTH) -> None:
        super().__init__()
        self.columns = TargetColumns(num_phones)
        self.entry = nn.Linear(NUM_INPUTS, width)
        self.first = nn.GRU(width, width, batch_first=True)
        self.second = nn.GRU(width, width, batch_first=True)
        components = [NUM_COMPONENTS, NUM_COMPONENTS, NUM_LIPS]
        self.sizes = [*components, num_phones, len(VoiceKind), 1, 1, 1, 1]
        self.output = nn.Linear(width, sum(self.sizes))

    def forward(self, inputs: Tensor) -> Tensor:
        """Compute the output rows: (batch, positions, 160) to (batch, positions, outputs)."""
        first, _ = self.first(torch.relu(self.entry(inputs)))
        second, _ = self.second(first)
        rows: Tensor = self.output(first + second)
        return rows

    def split(self, rows: Tensor) -> OutputParts:
        """Split output rows into their parts."""
        *ranges, voicing, pitch, level, effort = torch.split(rows, self.sizes, dim=-1)
        scalars = (scalar.squeeze(-1) for scalar in (voicing, pitch, level, effort))
        return OutputParts(*ranges, *scalars)

    @torch.no_grad()
    def rescale_lips(self, mean: Floats, deviation: Floats) -> None:
        """Express the lips in the units of the lip teacher, whose mean and deviation are given."""
        scale, offset = (
            torch.from_numpy(values).repeat(len(LIP_DELAYS_S)) for values in (deviation, mean)
        )
        rows = slice(2 * NUM_COMPONENTS, NUM_FEATURES)
        self.output.weight[rows] *= scale[:, None]
        self.output.bias[rows] = scale * self.output.bias[rows] + offset

    def loss(self, inputs: Tensor, targets: Tensor) -> Tensor:
        """Compute the loss of a batch; targets have the shape (batch, positions, columns)."""
        rows = self(inputs).float()
        now = self.split(rows)
        late, before = self.split(rows[:, LOOK_AHEAD:]), targets[:, :-LOOK_AHEAD]
        phones = before[..., self.columns.phones]
        pitch, voice = before[..., PITCH], before[..., VOICE]
        entropy = -(log_softmax(late.phones, dim=-1) * phones.nan_to_num()).sum(dim=-1)
        has_phones = ~phones[..., 0].isnan()  # unlike pauses, which were inserted
        is_voiced = ~pitch.isnan()
        voicing = binary_cross_entropy_with_logits(
            late.voicing, is_voiced.float(), reduction="none"
        )
        losses = (
            _squared_error(now.early, targets[..., self.columns.whisper]),
            _squared_error(late.late, before[..., self.columns.whisper]),
            LIPS_WEIGHT * _squared_error(now.lips, targets[..., self.columns.lips]),
            PHONES_WEIGHT * weighted_mean(entropy, has_phones),
            cross_entropy(late.voice.flatten(0, 1), voice.flatten().long()),
            VOICING_WEIGHT * weighted_mean(voicing, has_phones),
            weighted_mean((late.pitch + MEAN_PITCH - pitch.nan_to_num()).abs(), is_voiced),
            SCALAR_WEIGHT * _squared_error(late.level, before[..., LEVEL]),
            SCALAR_WEIGHT * _squared_error(late.effort, before[..., EFFORT]),
        )
        return torch.stack(losses).sum()


def _squared_error(outputs: Tensor, targets: Tensor) -> Tensor:
    return weighted_mean((outputs - targets.nan_to_num()).square(), ~targets.isnan())


def weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    """Return the mean; weights have the same shape, and may be true or false."""
    return (values * weights).sum() / weights.sum().clamp(min=1)
