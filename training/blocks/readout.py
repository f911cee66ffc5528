"""Read the states off Whisper's positions in a window: the readout, and how it learns.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
encoder, which stays as it is); Cho et al. 2014, "Learning phrase representations using RNN
encoder-decoder for statistical machine translation" (the GRU); Schuster and Paliwal 1997,
"Bidirectional recurrent neural networks"; Hinton, Vinyals and Dean 2015, "Distilling the knowledge
in a neural network" (soft targets).

    z = clip((concat(h_4, h_5, h_6) - mean) / deviation, -6, 6)
    a = gelu(W z)
    y = log softmax(V concat(GRU(a), a))

    loss = - sum_t w[t] sum_j q[t, j] log y[t, s[t, j]] / sum_t w[t] sum_j q[t, j]

====== ============================================================== ===================
symbol meaning                                                        shape
====== ============================================================== ===================
h_l    positions after layer l, as the recognizer computes them       (positions, width)
a      input of the GRU, which runs both ways                         (positions, 320)
y      log posteriors of the states at the frames 2 p and 2 p + 1     (frames, states)
s, q   target states of a frame and their probabilities               (frames, k)
w      weight of a frame: 1 in the last 0.4 s of the window, which    (frames,)
       are read live, and 1/4 before
====== ============================================================== ===================

The windows of a step are equally long and end anywhere, as they do live; many of the shorter ones
begin with the recording, as a segment of speech does. Their sound is augmented
(:mod:`training.neural.augmentation`), while the targets come from the clean recording. Every batch
is drawn by a generator of its own, so training that goes on later gives the same readout.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import gelu, log_softmax
from torch.optim.swa_utils import AveragedModel

from kouxing.training.neural.batches import Batch, Recording, Targets, augment, sampling_probs
from kouxing.training.neural.trainer import cross_entropy, late_mean, take_step
from kouxing.training.progress import Report

MAX_WINDOW_FRAMES = 250
MAX_DEVIATIONS = 6.0
_INNER, _GRU = 320, 192  # widths in the readout
_DROPOUT = 0.2
_NOISE = 0.15  # deviations, of each position
_NUM_KEPT = 8  # batches; mean and deviation are of the first ones

BATCH_S = 70
_MAX_WINDOWS = 64  # of a batch
_WHOLE_PROB, _FIXED_PROB, _FIXED_FRAMES = 0.35, 0.2, 150  # lengths; else any length
_WINDOWS_OF_RECORDING = 4  # in a batch
_FROM_START_PROB = 0.3  # of a window shorter than the longest
_MIN_FRAMES = 10
_READ_FRAMES, _EARLIER_WEIGHT = 40, 0.25
_RATE = 2e-3
_WEIGHT_DECAY = 0.02
_WARM_UP_STEPS = 30
_FALL = 0.6  # fraction of the steps, at the end, over which the rate falls to 0
_MAX_GRADIENT_NORM = 2.0
_MEAN_EXPONENT = 8  # of the running mean of the weights
_KEEP_EVERY = 25  # steps

Floats = NDArray[np.float32]
Encode = Callable[[Floats], Floats]  # log-mel frames, (frames, 80), to features, (positions, n)


class Readout(nn.Module):
    """Computes the posteriors of the states of two frames from each position's features."""

    mean: Tensor  # (features,)
    deviation: Tensor  # (features,)

    def __init__(self, num_features: int, num_states: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(num_features))
        self.register_buffer("deviation", torch.ones(num_features))
        self.inner = nn.Linear(num_features, _INNER)
        self.gru = nn.GRU(_INNER, _GRU, batch_first=True, bidirectional=True)
        self.output = nn.Linear(2 * _GRU + _INNER, 2 * num_states)
        self.dropout = nn.Dropout(_DROPOUT)

    def forward(self, features: Tensor) -> Tensor:
        """Compute log posteriors: (batch, positions, features) to (batch, 2 positions, states)."""
        inner = self.inner_of(features)
        context, _ = self.gru(inner)
        return self.log_posteriors(context, inner)

    def inner_of(self, features: Tensor) -> Tensor:
        """Compute the recurrent layer's input: (batch, positions, features) to (..., 320)."""
        standard = (features - self.mean) / self.deviation
        standard = standard.clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
        if self.training:
            standard = standard + _NOISE * torch.randn_like(standard)
        inner: Tensor = self.dropout(gelu(self.inner(standard)))
        return inner

    def log_posteriors(self, context: Tensor, inner: Tensor) -> Tensor:
        """Compute the output: (batch, positions, ...) to (batch, 2 positions, states)."""
        logits = self.output(self.dropout(torch.cat([context, inner], dim=-1)))
        return log_softmax(logits.unflatten(-1, (2, -1)).flatten(1, 2), dim=-1)


def train_readout(
    encode: Encode,
    recordings: Sequence[Recording],
    num_states: int,
    *,
    seed: int,
    num_steps: int,
    kept: Path,
    report: Report,
) -> Readout:
    """Train a readout.

    Parameters
    ----------
    encode
        Whisper's encoder, as the recognizer runs it.
    recordings
        With soft targets.
    num_states
        Of the targets.
    seed
        Of windows, augmentation and new weights.
    num_steps
        Number of batches of 70 s of sound.
    kept
        File that the state of training is written to now and then. If it is there, training goes
        on from it.
    report
        Receives lines of progress.
    """
    torch.manual_seed(seed)
    batches = Batches(encode, recordings, seed)
    first, _, _ = batches.of(0)
    readout = Readout(first.shape[-1], num_states)
    averaged = AveragedModel(readout, avg_fn=late_mean(_MEAN_EXPONENT))
    optimizer = torch.optim.AdamW(readout.parameters(), weight_decay=_WEIGHT_DECAY)
    done = 0
    if kept.exists():
        state = torch.load(kept, weights_only=True)
        done = state["step"]
        readout.load_state_dict(state["readout"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        report(f"going on after step {done}")
    else:
        some = torch.cat([batches.of(number)[0].flatten(0, 1) for number in range(_NUM_KEPT)])
        for module in (readout, cast(Readout, averaged.module)):
            module.mean[:] = some.mean(dim=0)
            module.deviation[:] = some.std(dim=0) + 1e-3
    losses = []
    for step in range(done, num_steps):
        torch.manual_seed(seed + step)
        rise = min(1.0, (step + 1) / _WARM_UP_STEPS)
        fall = min(1.0, (num_steps - step) / (_FALL * num_steps))
        optimizer.param_groups[0]["lr"] = _RATE * rise * fall
        features, states, probs = batches.of(_batch(step))
        loss = cross_entropy(readout(features), states, probs)
        take_step(loss, optimizer, readout, averaged, _MAX_GRADIENT_NORM)
        losses.append(float(loss.detach()))
        if (step + 1) % _KEEP_EVERY == 0 or step + 1 == num_steps:
            report(f"step {step + 1}: {np.mean(losses):.3f} nats a frame")
            losses = []
            state = {
                "step": step + 1,
                "readout": readout.state_dict(),
                "averaged": averaged.state_dict(),
                "optimizer": optimizer.state_dict(),
            }
            torch.save(state, kept)
    return cast(Readout, averaged.module).eval()


class Batches:
    """The batches of windows, each by its number."""

    def __init__(self, encode: Encode, recordings: Sequence[Recording], seed: int) -> None:
        self._encode = encode
        self._recordings = recordings
        self._probs = sampling_probs(recordings)
        self._seed = seed
        self._kept: dict[int, Batch] = {}

    def of(self, number: int) -> Batch:
        """Return a batch: features, (batch, positions, n), target states and their weights.

        The states and weights have the shape (batch, frames, k). The last batches are kept.
        """
        if number not in self._kept:
            if len(self._kept) == _NUM_KEPT:
                del self._kept[min(self._kept)]
            self._kept[number] = self._drawn(number)
        return self._kept[number]

    def _drawn(self, number: int) -> Batch:
        rng = np.random.default_rng([self._seed, number])
        length = _length(rng)
        num_windows = min(_MAX_WINDOWS, 100 * BATCH_S // length)
        windows: list[tuple[Floats, Targets]] = []
        while len(windows) < num_windows:
            windows += self._windows(length, rng)
        weights = np.where(np.arange(length) >= length - _READ_FRAMES, 1.0, _EARLIER_WEIGHT)
        features = torch.from_numpy(np.stack([self._encode(frames) for frames, _ in windows]))
        states = np.stack([targets.states for _, targets in windows]).astype(np.int64)
        probs = np.stack([targets.probs for _, targets in windows]).astype(np.float32)
        return (
            features,
            torch.from_numpy(states),
            torch.from_numpy(probs * weights[:, None].astype(np.float32)),
        )

    def _windows(self, length: int, rng: np.random.Generator) -> list[tuple[Floats, Targets]]:
        """Draw windows of an augmented recording; none if it is too short."""
        recording = self._recordings[rng.choice(len(self._probs), p=self._probs)]
        frames, targets = augment(recording, rng)
        windows = []
        for _ in range(_WINDOWS_OF_RECORDING if len(frames) >= length else 0):
            start = int(rng.integers(len(frames) - length + 1))
            if length < MAX_WINDOW_FRAMES and rng.random() < _FROM_START_PROB:
                start = 0
            place = slice(start, start + length)
            windows.append((frames[place], targets.of(place)))
        return windows


def _batch(step: int) -> int:
    """Return the number of a step's batch; encoding costs most, so every batch comes twice."""
    number = step // 2
    return number if step % 2 == 0 else max(number - _NUM_KEPT + 1, number % _NUM_KEPT)


def _length(rng: np.random.Generator) -> int:
    """Draw a window's length, feature frames, even."""
    draw = rng.random()
    if draw < _WHOLE_PROB:
        return MAX_WINDOW_FRAMES
    if draw < _WHOLE_PROB + _FIXED_PROB:
        return _FIXED_FRAMES
    return 2 * int(rng.integers(_MIN_FRAMES // 2, MAX_WINDOW_FRAMES // 2 + 1))
