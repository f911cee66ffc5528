"""Train the network on sounds whose frames have states as targets, changed anew each time.

Sources: Hinton et al. 2012, "Deep neural networks for acoustic modeling in speech recognition"
(cross-entropy on the states of a forced alignment); Hinton, Vinyals and Dean 2015, "Distilling the
knowledge in a neural network" (several states with a share each); Loshchilov and Hutter 2019,
"Decoupled weight decay regularization" (AdamW); Shamir and Zhang 2013, "Stochastic gradient descent
for non-smooth optimization: convergence results and optimal averaging schemes" (the running mean of
the weights, in which late ones weigh more).

Layers that come with weights learn slowly, what begins anew learns faster, and the convolutions
stay as they are. The rate rises and then stays: weights that keep moving differ more, and what is
kept, their mean, is the better for it.

    rate(n) = rate * min(1, (n + 1) / min(60, 0.2 N))

    m(0) = v(0),  m(n) = m(n - 1) + 3 / (n + 4) * (v(n) - m(n - 1))

    H = - sum_t sum_j w[t, j] log y[t, s[t, j]] / sum_t sum_j w[t, j]

    loss = H(main output) + H(another output) / 2, the others in turn

======== ============================================================= ================
symbol   meaning                                                       shape
======== ============================================================= ================
n, N     number of a step, and of all steps                            1
v, m     weights after a step, and their running mean                  as the weights
s, w     states that frames ought to say, and their shares, which sum  (frames, k)
         to one, or to zero where nothing is known
y        shares of the states that an output says                      (frames, states)
H        mean cross-entropy of an output, nats a frame                 1
======== ============================================================= ================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from services.recognizer.neural import MOST_POSITIONS
from services.recognizer.whisper_mel import WhisperMel
from training.feature_cache import as_floats
from training.network import Network, said_frames, short_products
from training.sound_change import changed_sound, changed_tempo, frames_before, levelled, mask

BATCH_S = 30  # of sound
_BATCH_FRAMES = 100 * BATCH_S
_MOST_FRAMES = 800  # of a recording in a batch; longer ones are cut
_POOL_BATCHES = 8  # recordings of like length are taken from so many batches' worth
_LATEST_START = 900  # position of a crop's first, as if it came from the middle of long speech
_RATE = 2e-4  # of the layers
_NEW_RATE = 1.2e-3  # of the last norm and the output layers
_NEW = ("norm.", "outputs.")
_KEPT = ("first.", "second.")
_WEIGHT_DECAY = 0.01
_WARM_UP_STEPS = 60
_MOST_WARM_UP = 0.2  # of the steps
_LONGEST_GRADIENT = 1.0
_EXPONENT = 2  # of the running mean of the weights
_OTHERS_WEIGHT = 0.5  # of the losses of other outputs than the main one
_CHANGED_SHARE = 0.9
_TEMPO_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Targets:
    """What frames ought to say: some states of 256 at most, and the share of each."""

    states: NDArray[np.uint8]  # (frames, k)
    shares: NDArray[np.float16]  # (frames, k)

    def __len__(self) -> int:
        return len(self.states)

    @classmethod
    def hard(cls, states: NDArray[np.integer[Any]]) -> Targets:
        """One state a frame, shape (frames,), with all of the share."""
        return cls(states[:, None].astype(np.uint8), np.ones((len(states), 1), np.float16))

    def of(self, frames: NDArray[np.int64] | slice) -> Targets:
        """Targets of some of the frames."""
        return Targets(self.states[frames], self.shares[frames])

    def halved_with(self, other: Targets) -> Targets:
        """Give half of the share to other targets of the same frames."""
        return Targets(
            np.hstack([self.states, other.states]),
            np.hstack([self.shares, other.shares]) * np.float16(0.5),
        )


Heard = tuple[NDArray[np.floating[Any]], Targets]  # what a batch is made of: (rows, inputs)
Batch = tuple[Tensor, Tensor, Tensor]  # inputs; states and shares, (batch, frames, k)


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """What the network hears."""

    samples: NDArray[np.int16]  # (n,) 16 kHz
    targets: Targets  # of its frames
    weight: float  # how often it is heard against the others


class Trainer:
    """Trains a network step by step.

    Parameters
    ----------
    network
        The network; trained in place.
    recordings
        With the targets of their frames.
    main_output
        Output layer that learns in every step; each step another one learns besides.
    seed
        Of order and changes of the sound. The network's dropout takes PyTorch's own.
    """

    def __init__(
        self,
        network: Network,
        recordings: Sequence[Recording],
        *,
        main_output: int,
        seed: int,
    ) -> None:
        self.network = network
        self.main_output = main_output
        self._averaged = AveragedModel(network, avg_fn=late_mean(_EXPONENT))
        self._averaged.eval()
        self._rng = np.random.default_rng(seed)
        self.replace_recordings(recordings)
        slow: list[nn.Parameter] = []
        fast: list[nn.Parameter] = []
        for name, parameter in network.named_parameters():
            if name.startswith(_KEPT):
                parameter.requires_grad_(False)
            else:
                (fast if name.startswith(_NEW) else slow).append(parameter)
        self._rates = (_RATE, _NEW_RATE)
        self._optimizer = torch.optim.AdamW(
            [{"params": slow}, {"params": fast}], weight_decay=_WEIGHT_DECAY
        )

    @property
    def mean(self) -> Network:
        """The network with the running mean of the weights."""
        return cast(Network, self._averaged.module)

    def replace_recordings(self, recordings: Sequence[Recording]) -> None:
        """Go on with other recordings, or other targets for the same."""
        share = shares_of(recordings)

        def draw() -> Heard:
            return heard_anew(recordings[self._rng.choice(len(share), p=share)], self._rng)

        self._batches = batches_of(draw, _BATCH_FRAMES, self._rng)

    def train(self, num_steps: int, watch: Callable[[int, float], None]) -> None:
        """Take steps.

        ``watch`` is told, after each step, how many there were and the loss of the main output
        in nats a frame.
        """
        warm_up_steps = min(_WARM_UP_STEPS, _MOST_WARM_UP * num_steps)
        for step in range(num_steps):
            share = min(1.0, (step + 1) / warm_up_steps)
            watch(step + 1, self._step(step, share))

    def _step(self, number: int, share: float) -> float:
        """Learn from one batch; return the mean cross-entropy of the main output."""
        self.network.train()
        frames, states, shares = next(self._batches)
        start = 0 if self._rng.random() < 0.5 else int(self._rng.integers(_LATEST_START))
        with short_products():
            hidden = self.network(frames, start)
            loss = self._loss(hidden, states, shares, self.main_output)
            main_loss = float(loss.detach())
            others = [k for k in range(len(self.network.outputs)) if k != self.main_output]
            if others:
                other = others[number % len(others)]
                loss = loss + _OTHERS_WEIGHT * self._loss(hidden, states, shares, other)
        for group, rate in zip(self._optimizer.param_groups, self._rates, strict=True):
            group["lr"] = share * rate
        learn(loss, self._optimizer, self.network, self._averaged, _LONGEST_GRADIENT)
        return main_loss

    def _loss(self, hidden: Tensor, states: Tensor, shares: Tensor, output: int) -> Tensor:
        """Mean cross-entropy of what an output says, nats a frame."""
        look_ahead = self.network.shape.look_aheads[output]
        due = due_targets(states, shares, hidden.shape[1], look_ahead)
        return cross_entropy(self.network.log_shares(hidden, output), *due)


def learn(
    loss: Tensor,
    optimizer: torch.optim.Optimizer,
    network: nn.Module,
    averaged: AveragedModel,
    longest_gradient: float,
) -> None:
    """Step down a gradient, shortened to that length; the running mean of the weights follows."""
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(network.parameters(), longest_gradient)
    optimizer.step()
    averaged.update_parameters(network)


def shares_of(recordings: Sequence[Recording]) -> NDArray[np.float64]:
    """How often each of the recordings is heard; the sum is one."""
    share = np.array([recording.weight for recording in recordings])
    share /= share.sum()
    return share


def batches_of(
    draw: Callable[[], Heard], num_rows: int, rng: np.random.Generator
) -> Iterator[Batch]:
    """Batches without end, of about so many rows, in which all are of like length."""
    while True:
        pool: list[Heard] = []
        size = 0
        while size < _POOL_BATCHES * num_rows:
            pool.append(draw())
            size += len(pool[-1][0])
        pool.sort(key=lambda pair: len(pair[0]))
        groups: list[list[Heard]] = [[]]
        for pair in pool:
            if groups[-1] and (len(groups[-1]) + 1) * len(pair[0]) > num_rows:
                groups.append([])
            groups[-1].append(pair)
        for at in rng.permutation(len(groups)):
            yield _padded(groups[at])


def cross_entropy(log_shares: Tensor, states: Tensor, shares: Tensor) -> Tensor:
    """Mean over the frames that have targets, in nats.

    Parameters
    ----------
    log_shares
        What is said, shape (..., states).
    states, shares
        What ought to be said, shape (..., k).
    """
    return -(log_shares.gather(-1, states) * shares).sum() / shares.sum().clamp(min=1.0)


def heard_anew(
    recording: Recording, rng: np.random.Generator
) -> tuple[NDArray[np.float32], Targets]:
    """Change a recording; return its frames, (frames, 80), and their targets."""
    samples, speed = as_floats(recording.samples), 1.0
    if rng.random() < _CHANGED_SHARE:
        samples, speed = changed_sound(samples, rng)
    frames = WhisperMel().accept_waveform(levelled(samples, rng))
    targets = recording.targets.of(frames_before(len(frames), speed, len(recording.targets)))
    if rng.random() < _TEMPO_SHARE:
        frames, were = changed_tempo(frames, rng)
        targets = targets.of(were)
    if len(frames) > _MOST_FRAMES:
        start = int(rng.integers(len(frames) - _MOST_FRAMES + 1))
        kept = slice(start, start + _MOST_FRAMES)
        frames, targets = frames[kept], targets.of(kept)
    mask(frames, rng)
    return frames, targets


def due_targets(
    states: Tensor, shares: Tensor, num_positions: int, look_ahead_frames: int
) -> tuple[Tensor, Tensor]:
    """Find what each position ought to say: (batch, frames, k) to (batch, positions, 2, k), both.

    Shares of frames that are not there are 0.
    """
    num_frames = states.shape[1]
    frames = said_frames(num_positions, look_ahead_frames)
    inside = (frames >= 0) & (frames < num_frames)
    at = frames.clamp(0, num_frames - 1)
    return states[:, at], shares[:, at] * inside[..., None]


@torch.no_grad()
def log_shares_of(network: Network, output: int, samples: NDArray[np.int16]) -> NDArray[np.float32]:
    """Log shares of the states in all frames of a recording, as the recognizer has them.

    The recognizer goes on position by position; here they are computed together, which is
    faster.

    Parameters
    ----------
    network
        The network.
    output
        Number of its output layer.
    samples
        Shape (n,), 16 kHz.

    Returns
    -------
    NDArray
        Shape (frames, states).
    """
    network.eval()
    frames = WhisperMel().accept_waveform(as_floats(samples))
    num_frames, look_ahead = len(frames), network.shape.look_aheads[output]
    num_positions = math.ceil((num_frames + look_ahead) / 2) - 1
    num_missing = max(0, 2 * num_positions + 1 - num_frames)
    seen = np.concatenate([frames, np.repeat(frames[-1:], num_missing, axis=0)])
    rows = []
    for start in range(0, num_positions, MOST_POSITIONS):  # as the recognizer begins again
        piece = seen[2 * start : 2 * (start + MOST_POSITIONS) + 1]
        hidden = network(torch.from_numpy(piece)[None])
        rows.append(network.log_shares(hidden, output)[0].flatten(0, 1).numpy())
    said = np.concatenate(rows)
    first = 2 - look_ahead  # frame of the first row
    said = said[-first:] if first < 0 else np.concatenate([said[:1]] * first + [said])
    return np.ascontiguousarray(said[:num_frames])


def late_mean(exponent: int) -> Callable[[Tensor, Tensor, Tensor | int], Tensor]:
    """Make a running mean in which the n-th weights weigh about n ** exponent."""

    def moved(mean: Tensor, weights: Tensor, num_before: Tensor | int) -> Tensor:
        share = (exponent + 1) / (int(num_before) + exponent + 2)
        return mean + share * (weights - mean)

    return moved


def _padded(group: Sequence[Heard]) -> Batch:
    """Make a batch; what is short goes on with its last row, of which nothing is known."""
    longest = max(len(rows) for rows, _ in group) | 1  # an odd number: positions see 2 n + 1
    inputs = np.empty((len(group), longest, group[0][0].shape[1]), dtype=np.float32)
    num_frames = max(len(targets) for _, targets in group)
    most_states = max(targets.states.shape[1] for _, targets in group)
    states = np.zeros((len(group), num_frames, most_states), dtype=np.int64)
    shares = np.zeros(states.shape, dtype=np.float32)
    for number, (rows, targets) in enumerate(group):
        inputs[number, : len(rows)] = rows
        inputs[number, len(rows) :] = rows[-1]
        place = number, slice(len(targets)), slice(targets.states.shape[1])
        states[place] = targets.states
        shares[place] = targets.shares
    return torch.from_numpy(inputs), torch.from_numpy(states), torch.from_numpy(shares)
