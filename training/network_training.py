"""Train the recurrent network on aligned frames, with a second language as a second task.

Sources: Hinton et al. 2012, "Deep neural networks for acoustic modeling in speech recognition"
(cross-entropy on the states of a forced alignment); Huang et al. 2013, "Cross-language knowledge
transfer using multilingual deep neural network with shared hidden layers" (the second task); Park
et al. 2019, "SpecAugment" (masks); Kingma and Ba 2015, "Adam"; Polyak and Juditsky 1992 (running
mean of the weights).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import log_softmax
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from services.recognizer.features import LiveMean
from training.augmentation import Augmentation
from training.network import NUM_INPUTS, Network

_BATCH_FRAMES = 5000
_MOST_FRAMES = 500  # of a recording in a batch; longer ones are cut
_POOL_BATCHES = 12  # recordings of like length are taken from so many batches' worth
_RATE = 1.5e-3
_WARM_UP_STEPS = 150
_FALL_SHARE = 0.3  # of the steps, at the end, over which the rate falls to nothing
_HEADS_ALONE_SHARE = 0.08  # of the steps, at the very end
_LONGEST_GRADIENT = 2.0
_MEMORY = 0.998  # of the running mean of the weights, per step
_AUGMENTED_SHARE = 0.85
_KNOWN_SPEAKER_SHARE = 0.4  # of the recordings, heard as if the speaker had spoken before
_OTHERS_WEIGHT = 0.5  # of the losses of other output layers than the main one
_MOST_MASKED_FRAMES, _MOST_MASKED_BANDS = 12, 7
NO_TARGET = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """What the network hears: one sentence in one or several voices."""

    voices: tuple[NDArray[np.float16], ...]  # (frames, 41) each
    targets: NDArray[np.int64]  # (frames,) states; those of the second task follow the others
    weight: float  # how often it is heard against the others


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontEnd:
    """How log-mel frames are normalised before the network."""

    prior_mean: NDArray[np.float32]  # (41,)
    spread: NDArray[np.float32]  # (41,)

    @classmethod
    def measure(cls, recordings: Sequence[Recording]) -> FrontEnd:
        """Mean and standard deviation over some of the recordings."""
        some = recordings[:: max(1, len(recordings) // 300)]
        log_mels = [recording.voices[0].astype(np.float32) for recording in some]
        return cls(
            prior_mean=np.mean([frames.mean(axis=0) for frames in log_mels], axis=0),
            spread=np.mean([frames.std(axis=0) for frames in log_mels], axis=0),
        )

    def normalise(self, log_mel: NDArray[np.float32], *, known: bool) -> NDArray[np.float32]:
        """Normalise as a live session would; ``known``: the speaker has spoken before."""
        mean = LiveMean(self.prior_mean)
        if known:
            mean.normalise(log_mel)
        normalised: NDArray[np.float32] = mean.normalise(log_mel) / self.spread
        return normalised


class Trainer:
    """Trains a network step by step.

    Parameters
    ----------
    network
        The network; trained in place.
    front_end
        Normalisation.
    recordings
        With the states of their frames.
    main_head
        Output layer that learns in every step; each step another one learns besides.
    seed
        Of order and augmentation.
    """

    def __init__(
        self,
        network: Network,
        front_end: FrontEnd,
        recordings: Sequence[Recording],
        *,
        main_head: int,
        seed: int,
    ) -> None:
        self.network = network
        average = get_ema_multi_avg_fn(_MEMORY)  # type: ignore[no-untyped-call]
        self._averaged = AveragedModel(network, multi_avg_fn=average)
        self.front_end = front_end
        self._rng = np.random.default_rng(seed)
        self.main_head = main_head
        self.replace_recordings(recordings)
        self._optimizer = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=0.01)

    @property
    def mean(self) -> Network:
        """The network with the running mean of the weights."""
        return cast(Network, self._averaged.module)

    def replace_recordings(self, recordings: Sequence[Recording]) -> None:
        """Go on with other recordings, or other targets for the same."""
        self._batches = self._batches_of(recordings)

    def train(self, num_steps: int, watch: Callable[[int, float], None]) -> None:
        """Take steps; the learning rate rises, stays, and falls to nothing.

        In the last steps only the output layers learn, all of them, from a trunk that stays.
        ``watch`` is told, after each step, how many there were and the loss of the main output
        layer in nats a frame.
        """
        num_heads_alone = round(_HEADS_ALONE_SHARE * num_steps)
        num_whole = num_steps - num_heads_alone
        fall_steps = _FALL_SHARE * num_whole
        for step in range(num_whole):
            rise = min(1.0, (step + 1) / _WARM_UP_STEPS)
            fall = min(1.0, (num_whole - step) / fall_steps)
            watch(step + 1, self._step(step, _RATE * rise * fall))
        for step in range(num_heads_alone):
            rate = _RATE * (1 - step / num_heads_alone)
            watch(num_whole + step + 1, self._step_of_heads(rate))

    def _step(self, number: int, rate: float) -> float:
        """Learn from one batch; return the mean cross-entropy of the main output layer."""
        self.network.train()
        frames, targets = next(self._batches)
        hidden = self.network(frames)
        loss = _cross_entropy(*self._log_shares(hidden, targets, self.main_head))
        main_loss = float(loss.detach())
        others = [head for head in range(len(self.network.heads)) if head != self.main_head]
        if others:
            other = self._log_shares(hidden, targets, others[number % len(others)])
            loss = loss + _OTHERS_WEIGHT * _cross_entropy(*other)
        second = targets - self.network.shape.num_states
        if (second >= 0).any():
            delay = self.network.shape.look_aheads[self.main_head]
            log_shares = log_softmax(self.network.second_task(hidden[:, delay:]), dim=-1)
            due = second[:, : hidden.shape[1] - delay]
            loss = loss + _OTHERS_WEIGHT * _cross_entropy(log_shares, due)
        self._learn(loss, rate)
        return main_loss

    def _step_of_heads(self, rate: float) -> float:
        self.network.train()
        frames, targets = next(self._batches)
        with torch.no_grad():
            hidden = self.network(frames)
        losses = [
            _cross_entropy(*self._log_shares(hidden, targets, head))
            for head in range(len(self.network.heads))
        ]
        self._learn(torch.stack(losses).sum(), rate)
        return float(losses[self.main_head].detach())

    def _log_shares(self, hidden: Tensor, targets: Tensor, head: int) -> tuple[Tensor, Tensor]:
        """Return what an output layer says, and the states it ought to say."""
        delay = self.network.shape.look_aheads[head]
        log_shares = log_softmax(self.network.heads[head](hidden[:, delay:]), dim=-1)
        due = targets[:, : hidden.shape[1] - delay]
        return log_shares, torch.where(due < self.network.shape.num_states, due, NO_TARGET)

    def _learn(self, loss: Tensor, rate: float) -> None:
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), _LONGEST_GRADIENT)
        self._optimizer.step()
        self._averaged.update_parameters(self.network)

    def _batches_of(self, recordings: Sequence[Recording]) -> Iterator[tuple[Tensor, Tensor]]:
        """Batches without end: frames (batch, longest, 41), targets (batch, longest)."""
        share = np.array([recording.weight for recording in recordings])
        share /= share.sum()
        while True:
            heard: list[tuple[NDArray[np.float32], NDArray[np.int64]]] = []
            size = 0
            while size < _POOL_BATCHES * _BATCH_FRAMES:
                heard.append(self._heard(recordings[self._rng.choice(len(share), p=share)]))
                size += len(heard[-1][0])
            heard.sort(key=lambda pair: len(pair[0]))
            groups: list[list[tuple[NDArray[np.float32], NDArray[np.int64]]]] = [[]]
            for pair in heard:
                if groups[-1] and (len(groups[-1]) + 1) * len(pair[0]) > _BATCH_FRAMES:
                    groups.append([])
                groups[-1].append(pair)
            for at in self._rng.permutation(len(groups)):
                yield _padded(groups[at])

    def _heard(self, recording: Recording) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """One voice of a recording, changed anew, and its targets."""
        rng = self._rng
        voice = recording.voices[rng.integers(len(recording.voices))].astype(np.float32)
        targets = recording.targets
        if rng.random() < _AUGMENTED_SHARE:
            augmentation = Augmentation.draw_hard(rng)
            targets = targets[np.rint(augmentation.positions(len(voice))).astype(int)]
            voice = augmentation.apply(voice)
        frames = self.front_end.normalise(voice, known=rng.random() < _KNOWN_SPEAKER_SHARE)
        if len(frames) > _MOST_FRAMES:
            start = int(rng.integers(len(frames) - _MOST_FRAMES + 1))
            frames = frames[start : start + _MOST_FRAMES]
            targets = targets[start : start + _MOST_FRAMES]
        for _ in range(rng.integers(3)):
            at, width = rng.integers(len(frames)), rng.integers(1, _MOST_MASKED_FRAMES + 1)
            frames[at : at + width] = 0.0
        for _ in range(rng.integers(3)):
            at, width = rng.integers(1, NUM_INPUTS), rng.integers(1, _MOST_MASKED_BANDS + 1)
            frames[:, at : at + width] = 0.0
        return frames, targets


def _cross_entropy(log_shares: Tensor, targets: Tensor) -> Tensor:
    """Nats a frame that has a target."""
    known = targets >= 0
    said = log_shares.gather(-1, targets.clamp(min=0)[..., None])[..., 0]
    return -(said * known).sum() / max(1, int(known.sum()))


def _padded(
    group: list[tuple[NDArray[np.float32], NDArray[np.int64]]],
) -> tuple[Tensor, Tensor]:
    longest = max(len(frames) for frames, _ in group)
    frames = np.zeros((len(group), longest, NUM_INPUTS), dtype=np.float32)
    targets = np.full((len(group), longest), NO_TARGET, dtype=np.int64)
    for row, (one, of_one) in enumerate(group):
        frames[row, : len(one)] = one
        targets[row, : len(of_one)] = of_one
    return torch.from_numpy(frames), torch.from_numpy(targets)
