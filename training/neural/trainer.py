"""Train the network on augmented recordings whose frames have target states.

Sources: Hinton et al. 2012, "Deep neural networks for acoustic modeling in speech recognition"
(cross-entropy on the states of a forced alignment); Hinton, Vinyals and Dean 2015, "Distilling the
knowledge in a neural network" (soft targets).

Pretrained layers have a low learning rate, new layers a higher one. The convolutions are frozen.
The learning rate rises and then stays constant. Varied weights make the running mean better.

    rate(n) = rate * min(1, (n + 1) / min(60, 0.2 N))

    H = - sum_t sum_j q[t, j] log y[t, s[t, j]] / sum_t sum_j q[t, j]

    loss = H(main output) + H(another output) / 2, the others in turn

======== ============================================================= ================
symbol   meaning                                                       shape
======== ============================================================= ================
n, N     number of a step, and of all steps                            1
s, q     target states of a frame and their probabilities, which sum   (frames, k)
         to 1, or to 0 if no target is known
y        posteriors of the states, of an output layer                  (frames, states)
H        mean cross-entropy of an output layer, nats a frame           1
======== ============================================================= ================
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from torch import Tensor, nn

from kouxing.training.neural.augmentation import mask
from kouxing.training.neural.batches import Recording, Sample, augment, batches_of, sampling_probs
from kouxing.training.neural.network import Network, mixed_precision, output_frames
from kouxing.training.neural.optimizer import Optimizer, cross_entropy

BATCH_S = 30
_BATCH_FRAMES = 100 * BATCH_S
_MAX_START = 900  # position of a crop's first frame, as if it came from the middle of long speech
_RATE = 2e-4  # of the pretrained layers
_NEW_RATE = 1.2e-3  # of the last norm and the output layers
_NEW = ("norm.", "outputs.")
_FROZEN = ("first.", "second.")
_WARM_UP_STEPS = 60
_MAX_WARM_UP = 0.2  # fraction of the steps
_OTHER_OUTPUT_WEIGHT = 0.5  # of the loss of the other output layer


class Trainer:
    """Trains a network in place, step by step.

    Every step trains the output layer ``main_output`` and one other layer, which changes. ``seed``
    determines order and augmentation. Dropout draws from PyTorch's own generator.
    """

    def __init__(
        self, network: Network, recordings: Sequence[Recording], *, main_output: int, seed: int
    ) -> None:
        self.network = network
        self.main_output = main_output
        self._rng = np.random.default_rng(seed)
        self.replace_recordings(recordings)
        pretrained: list[nn.Parameter] = []
        new: list[nn.Parameter] = []
        for name, parameter in network.named_parameters():
            if name.startswith(_FROZEN):
                parameter.requires_grad_(False)
            else:
                (new if name.startswith(_NEW) else pretrained).append(parameter)
        self._optimizer = Optimizer(
            network,
            [{"params": pretrained, "lr": _RATE}, {"params": new, "lr": _NEW_RATE}],
            weight_decay=0.01,
            max_norm=1.0,
            mean_exponent=2,
        )

    @property
    def mean(self) -> Network:
        """The network with the running mean of the weights."""
        return self._optimizer.mean

    def replace_recordings(self, recordings: Sequence[Recording]) -> None:
        """Continue with these recordings, or with other targets of the same ones."""
        probs = sampling_probs(recordings)

        def draw() -> Sample:
            number = self._rng.choice(len(probs), p=probs)
            frames, targets = augment(recordings[number], self._rng)
            mask(frames, self._rng)
            return frames, targets

        self._batches = batches_of(draw, _BATCH_FRAMES, self._rng)

    def train(self, num_steps: int) -> Iterator[tuple[int, float]]:
        """Yield the number of steps taken and the loss of the main output layer after each."""
        warm_up_steps = min(_WARM_UP_STEPS, _MAX_WARM_UP * num_steps)
        for step in range(num_steps):
            yield step + 1, self._step(step, min(1.0, (step + 1) / warm_up_steps))

    def _step(self, number: int, rate_factor: float) -> float:
        """Train on one batch; return the mean cross-entropy of the main output layer."""
        self.network.train()
        frames, states, probs = next(self._batches)
        start = 0 if self._rng.random() < 0.5 else int(self._rng.integers(_MAX_START))
        with mixed_precision():
            hidden = self.network(frames, start)
            loss = self._loss(hidden, states, probs, self.main_output)
            main_loss = float(loss.detach())
            others = [k for k in range(len(self.network.outputs)) if k != self.main_output]
            if others:
                other = others[number % len(others)]
                loss = loss + _OTHER_OUTPUT_WEIGHT * self._loss(hidden, states, probs, other)
        self._optimizer.step(loss, rate_factor)
        return main_loss

    def _loss(self, hidden: Tensor, states: Tensor, probs: Tensor, output: int) -> Tensor:
        look_ahead = self.network.shape.look_aheads[output]
        shifted = shift_targets(states, probs, hidden.shape[1], look_ahead)
        return cross_entropy(self.network.log_posteriors(hidden, output), *shifted)


def shift_targets(
    states: Tensor, probs: Tensor, num_positions: int, look_ahead_frames: int
) -> tuple[Tensor, Tensor]:
    """Find the targets of each position's two output frames.

    States and probabilities, (batch, frames, k), become (batch, positions, 2, k). The probabilities
    of frames outside the recording are 0.
    """
    num_frames = states.shape[1]
    frames = output_frames(num_positions, look_ahead_frames)
    inside = (frames >= 0) & (frames < num_frames)
    at = frames.clamp(0, num_frames - 1)
    return states[:, at], probs[:, at] * inside[..., None]
