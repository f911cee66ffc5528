"""Train the neural acoustic model on frames aligned by the Gaussian mixture model.

Source: Hinton et al. 2012, "Deep neural networks for acoustic modeling in speech recognition":
cross-entropy on the states of a forced alignment; Kingma and Ba 2015, "Adam"; Srivastava et al.
2014, "Dropout". Plain numpy: the network is small, and nothing but what the recognizer itself
depends on is needed.

======== ============================================================ ===================
symbol   meaning                                                      shape
======== ============================================================ ===================
x        log-mel frames in a stretch around the present one           (batch, inputs)
y        state of the present frame                                   (batch,)
W, b     weights and biases of a layer                                (in, out), (out,)
g        gradient of the mean cross-entropy                           like W, b
m, v     running means of g and g^2 (Adam)                            like W, b
======== ============================================================ ===================
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import Topology
from services.recognizer.features import LiveMean
from services.recognizer.neural import NUM_INPUTS, NeuralModel
from training.augmentation import Augmentation
from training.examples import Example

# Dense around the present, sparse in the past, which costs no delay; 4 frames of look-ahead.
FRAME_OFFSETS = np.array([-15, -12, -9, -7, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4])
HIDDEN = (512, 384, 384)
_BATCH = 512
_POOL_FRAMES = 40_000  # shuffled together
_LEARNING_RATE = 1e-3
_DROPOUT = 0.15  # share of the hidden values left out of each step
_HEARINGS = 2  # of an utterance of weight 1 in an epoch
_AUGMENTED_SHARE = 0.75
_KNOWN_SPEAKER_SHARE = 0.5  # of the recordings, heard as if the speaker had spoken before
_ADAM_MEAN, _ADAM_SQUARE, _ADAM_SMALL = 0.9, 0.999, 1e-8


def train_network(
    examples: Sequence[Example],
    states: Sequence[NDArray[np.int64]],
    topology: Topology,
    *,
    num_epochs: int,
    seed: int,
    report: Callable[[str], None],
    keep: Callable[[int, NeuralModel], None] | None = None,
    hidden: Sequence[int] = HIDDEN,
) -> NeuralModel:
    """Train a network from nothing.

    Parameters
    ----------
    examples
        Utterances; ``weight`` is how often each is heard in an epoch.
    states
        State of every frame of every utterance, (frames,) each.
    topology
        The HMMs that the states belong to.
    num_epochs
        Passes over the data; the learning rate falls to nothing over them.
    seed
        Of weights, order and augmentation.
    report
        Receives a line of progress now and then.
    keep
        Receives the model after each epoch.
    hidden
        Width of the hidden layers.
    """
    rng = np.random.default_rng(seed)
    sample = [e.log_mel.astype(np.float32) for e in examples[:: max(1, len(examples) // 300)]]
    prior_mean = np.mean([log_mel.mean(axis=0) for log_mel in sample], axis=0)
    spread = np.mean([log_mel.std(axis=0) for log_mel in sample], axis=0)
    counts = np.ones(topology.num_states)
    for example, path in zip(examples, states, strict=True):
        counts += example.weight * np.bincount(path, minlength=topology.num_states)
    widths = [len(FRAME_OFFSETS) * NUM_INPUTS, *hidden, topology.num_states]
    model = NeuralModel(
        topology=topology,
        weights=tuple(
            (rng.normal(size=(a, b)) * np.sqrt(2 / a)).astype(np.float32)
            for a, b in pairwise(widths)
        ),
        biases=tuple(np.zeros(width, np.float32) for width in widths[1:]),
        log_prior=np.log(counts / counts.sum()).astype(np.float32),
        frame_offsets=FRAME_OFFSETS,
        prior_mean=prior_mean.astype(np.float32),
        spread=spread.astype(np.float32),
        kappa=1.0,
    )
    frames_of_epoch = sum(e.weight * len(path) for e, path in zip(examples, states, strict=True))
    num_steps = max(1, int(num_epochs * _HEARINGS * frames_of_epoch / _BATCH))
    adam = _Adam([*model.weights, *model.biases], num_steps)
    for epoch in range(num_epochs):
        losses, rights, seen = 0.0, 0, 0
        for inputs, targets in _batches(examples, states, model, rng):
            loss, right, gradients = gradients_of(model, inputs, targets, rng)
            adam.step(gradients)
            losses, rights, seen = losses + loss * len(inputs), rights + right, seen + len(inputs)
            if (seen // _BATCH) % 500 == 0:
                report(f"epoch {epoch}: {losses / seen:.3f} nats, {rights / seen:.3f} right")
        report(f"epoch {epoch} ends: {losses / seen:.3f} nats, {rights / seen:.3f} right")
        if keep:
            keep(epoch, model)
    return model


def gradients_of(
    model: NeuralModel,
    inputs: NDArray[np.float32],
    targets: NDArray[np.int64],
    rng: np.random.Generator | None = None,
) -> tuple[float, int, list[NDArray[np.float32]]]:
    """Mean cross-entropy, number of right frames, and the gradients of all weights and biases.

    Parameters
    ----------
    model
        The network.
    inputs
        Shape (batch, inputs).
    targets
        States, shape (batch,).
    rng
        Draws the hidden values that are left out; None leaves out none.
    """
    outputs = [inputs]
    kept_gain = np.float32(1 / (1 - _DROPOUT) if rng else 1)
    for weights, biases in zip(model.weights[:-1], model.biases[:-1], strict=True):
        hidden = outputs[-1] @ weights
        hidden += biases
        np.maximum(hidden, 0, out=hidden)
        if rng:
            hidden *= (rng.random(hidden.shape, dtype=np.float32) >= _DROPOUT) * kept_gain
        outputs.append(hidden)
    logits = outputs[-1] @ model.weights[-1] + model.biases[-1]
    right = int((logits.argmax(axis=1) == targets).sum())
    logits -= logits.max(axis=1, keepdims=True)
    share = np.exp(logits)
    share /= share.sum(axis=1, keepdims=True)
    rows = np.arange(len(inputs))
    loss = float(-np.log(np.maximum(share[rows, targets], 1e-20)).mean())
    share[rows, targets] -= 1
    slope = share / np.float32(len(inputs))
    of_weights: list[NDArray[np.float32]] = []
    of_biases: list[NDArray[np.float32]] = []
    for layer in range(len(model.weights) - 1, -1, -1):
        of_weights.append(outputs[layer].T @ slope)
        of_biases.append(slope.sum(axis=0))
        if layer:
            slope = slope @ model.weights[layer].T
            slope *= (outputs[layer] > 0) * kept_gain
    return loss, right, [*of_weights[::-1], *of_biases[::-1]]


class _Adam:
    """Kingma and Ba 2015, algorithm 1; the learning rate falls in a straight line to nothing."""

    def __init__(self, parameters: Sequence[NDArray[np.float32]], num_steps: int) -> None:
        self._parameters = parameters
        self._means = [np.zeros_like(p) for p in parameters]
        self._squares = [np.zeros_like(p) for p in parameters]
        self._num_steps = num_steps
        self._step = 0

    def step(self, gradients: Sequence[NDArray[np.float32]]) -> None:
        """Move all parameters, in place."""
        self._step += 1
        rate = _LEARNING_RATE * max(0.01, 1 - self._step / self._num_steps)
        rate *= np.sqrt(1 - _ADAM_SQUARE**self._step) / (1 - _ADAM_MEAN**self._step)
        for parameter, gradient, mean, square in zip(
            self._parameters, gradients, self._means, self._squares, strict=True
        ):
            mean[...] += np.float32(1 - _ADAM_MEAN) * (gradient - mean)
            square[...] += np.float32(1 - _ADAM_SQUARE) * (gradient * gradient - square)
            change = np.float32(rate) * mean / (np.sqrt(square) + np.float32(_ADAM_SMALL))
            parameter[...] -= change


def _batches(
    examples: Sequence[Example],
    states: Sequence[NDArray[np.int64]],
    model: NeuralModel,
    rng: np.random.Generator,
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.int64]]]:
    """One epoch in shuffled batches, every recording changed anew."""
    times = _HEARINGS * np.array([example.weight for example in examples])
    draws = np.floor(times + rng.random(len(times))).astype(int)  # 1.3 is heard once or twice
    order = rng.permutation(np.repeat(np.arange(len(examples)), draws))
    frames: list[NDArray[np.float32]] = []
    targets: list[NDArray[np.int64]] = []
    centres: list[NDArray[np.int64]] = []
    size = 0
    for position, number in enumerate(order):
        padded, path = _heard(examples[number], states[number], model, rng)
        centres.append(size - int(FRAME_OFFSETS[0]) + np.arange(len(path)))
        frames.append(padded)
        targets.append(path)
        size += len(padded)
        if size > _POOL_FRAMES or position == len(order) - 1:
            pool, of_pool = np.concatenate(frames), np.concatenate(targets)
            at = np.concatenate(centres)
            shuffled = rng.permutation(len(of_pool))
            for start in range(0, len(shuffled) - _BATCH + 1, _BATCH):
                rows = shuffled[start : start + _BATCH]
                stretch = pool[at[rows][:, None] + FRAME_OFFSETS]
                yield stretch.reshape(len(rows), -1), of_pool[rows]
            frames, targets, centres, size = [], [], [], 0


def _heard(
    example: Example, path: NDArray[np.int64], model: NeuralModel, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Features as the recognizer would have them, padded at both ends, and the states."""
    log_mel = example.log_mel.astype(np.float32)
    if rng.random() < _AUGMENTED_SHARE:
        augmentation = Augmentation.draw(rng)
        path = path[np.rint(augmentation.positions(len(path))).astype(int)]
        log_mel = augmentation.apply(log_mel)
    mean = LiveMean(model.prior_mean)
    if rng.random() < _KNOWN_SPEAKER_SHARE:
        mean.normalise(log_mel)
    frames = mean.normalise(log_mel) / model.spread
    padded = np.pad(frames, ((-FRAME_OFFSETS[0], FRAME_OFFSETS[-1]), (0, 0)), mode="edge")
    return padded, path
