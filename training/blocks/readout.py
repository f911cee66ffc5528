"""Train the first readout of the block model on windows of Whisper's unchanged encoder.

Source: Hinton, Vinyals and Dean 2015, "Distilling the knowledge in a neural network" (soft
targets).

    loss = - sum_t w[t] sum_j q[t, j] log y[t, s[t, j]] / sum_t w[t] sum_j q[t, j]

====== ============================================================== ===================
symbol meaning                                                        shape
====== ============================================================== ===================
y      posteriors of the states                                       (frames, states)
s, q   target states of a frame and their probabilities               (frames, k)
w      weight of a frame: 1 in the last 0.4 s of the window, which    (frames,)
       are read live, and 1/4 before
====== ============================================================== ===================

The windows of a step have one length and end anywhere, as live. Many of the shorter ones start with
the recording, as a segment of speech does. The audio is augmented; the targets come from the clean
recording. Every batch has its own random generator, so resumed training gives the same readout.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kouxing.services.recognizer.front_end.whisper_mel import FLOOR_BANDS
from kouxing.training.device import mixed_precision
from kouxing.training.neural.batches import Batch, Recording, Targets, augment, sampling_probs
from kouxing.training.neural.network import Readout, ReadoutShape
from kouxing.training.neural.optimizer import Optimizer, cross_entropy, warm_up_and_decay_factor
from kouxing.training.neural.teacher import WholeEncoder
from kouxing.training.training_set import Report

MAX_WINDOW_FRAMES = 250
READOUT = ReadoutShape(inner=320, gru=192, dropout=0.2, noise=0.15)
_NUM_CACHED = 8  # batches

BATCH_S = 70
_MAX_WINDOWS = 64  # of a batch
_WHOLE_PROB, _FIXED_PROB, _FIXED_FRAMES = 0.35, 0.2, 150  # lengths; else any length
_WINDOWS_OF_RECORDING = 4  # in a batch
_FROM_START_PROB = 0.3  # of a window shorter than the longest
_MIN_FRAMES = 10
_READ_FRAMES, _EARLIER_WEIGHT = 40, 0.25
_WARM_UP_STEPS = 30
_FALLING = 0.6  # fraction of the steps, at the end, over which the rate falls to 0

Floats = NDArray[np.float32]


def train_readout(
    encoder: WholeEncoder,
    recordings: Sequence[Recording],
    num_states: int,
    *,
    seed: int,
    num_steps: int,
    checkpoint: Path,
    report: Report,
) -> Readout:
    """Train a readout of states on windows.

    Training saves its state in ``checkpoint``, and resumes from it if the file exists.
    """
    torch.manual_seed(seed)
    batches = Batches(encoder, recordings, seed)
    some = torch.cat([batches.get(number)[0].flatten(0, 1) for number in range(_NUM_CACHED)])
    readout = Readout(some.shape[-1], num_states, READOUT)
    readout.standardize(some)
    groups = [{"params": list(readout.parameters()), "lr": 2e-3}]
    optimizer = Optimizer(readout, groups, weight_decay=0.02, max_norm=2.0, mean_exponent=8)

    def loss(step: int) -> Tensor:
        features, states, probs = batches.get(_batch(step))
        return cross_entropy(readout(features), states, probs)

    return optimizer.train(
        loss,
        lambda step: warm_up_and_decay_factor(step, num_steps, _WARM_UP_STEPS, _FALLING),
        num_steps=num_steps,
        seed=seed,
        report=report,
        checkpoint=checkpoint,
    )


class Batches:
    """Batches of windows by number."""

    def __init__(self, encoder: WholeEncoder, recordings: Sequence[Recording], seed: int) -> None:
        self._encoder = encoder
        self._recordings = recordings
        self._probs = sampling_probs(recordings)
        self._seed = seed
        self._cache: dict[int, Batch] = {}

    def get(self, number: int) -> Batch:
        """Return features, (batch, positions, n), target states and weights, (batch, frames, k)."""
        if number not in self._cache:
            if len(self._cache) == _NUM_CACHED:
                del self._cache[min(self._cache)]
            self._cache[number] = self._draw(number)
        return self._cache[number]

    def _draw(self, number: int) -> Batch:
        rng = np.random.default_rng([self._seed, number])
        length = _length(rng)
        num_windows = min(_MAX_WINDOWS, 100 * BATCH_S // length)
        windows: list[tuple[Floats, Targets]] = []
        while len(windows) < num_windows:
            windows += self._windows(length, rng)
        weights = np.where(np.arange(length) >= length - _READ_FRAMES, 1.0, _EARLIER_WEIGHT)
        features = encode_windows(self._encoder, np.stack([frames for frames, _ in windows]))
        states = np.stack([targets.states for _, targets in windows]).astype(np.int64)
        probs = np.stack([targets.probs for _, targets in windows]).astype(np.float32)
        return (
            features,
            torch.from_numpy(states),
            torch.from_numpy(probs * weights[:, None].astype(np.float32)),
        )

    def _windows(self, length: int, rng: np.random.Generator) -> list[tuple[Floats, Targets]]:
        """Draw windows of an augmented recording; no windows if it is too short."""
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


@torch.no_grad()
def encode_windows(encoder: WholeEncoder, frames: Floats) -> Tensor:
    """Encode windows: log-mel frames, (batch, frames, 80), to (batch, positions, features)."""
    bands = np.maximum(frames, frames.max(axis=(1, 2), keepdims=True) - FLOOR_BANDS)
    with mixed_precision():
        features: Tensor = encoder(torch.from_numpy(bands).transpose(1, 2))
    return features.float()


def _batch(step: int) -> int:
    """Return the number of a step's batch; each is used twice, because encoding costs most."""
    number = step // 2
    return number if step % 2 == 0 else max(number - _NUM_CACHED + 1, number % _NUM_CACHED)


def _length(rng: np.random.Generator) -> int:
    draw = rng.random()
    if draw < _WHOLE_PROB:
        return MAX_WINDOW_FRAMES
    if draw < _WHOLE_PROB + _FIXED_PROB:
        return _FIXED_FRAMES
    return 2 * int(rng.integers(_MIN_FRAMES // 2, MAX_WINDOW_FRAMES // 2 + 1))
