"""Neural acoustic model: a feed-forward network over a stretch of log-mel frames.

Source: Hinton et al. 2012, "Deep neural networks for acoustic modeling in speech recognition"
(hybrid of network and HMM). The network replaces the Gaussian mixtures of Li et al. 2011, section
3.1; units, HMMs, search and output rule stay the paper's.

======== ========================================================== ==================
symbol   meaning                                                    shape
======== ========================================================== ==================
x        normalised log energy and log-mel bands, several frames    (frames * 41,)
W, b     weights and biases of a layer                              (in, out), (out,)
prior    share of a state in the training data                      (states,)
kappa    scale of the log scores, chosen on development data        1
======== ========================================================== ==================

    h = max(0, h W + b);   log b(x) = kappa * (log softmax(h W + b) - log prior)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import Topology
from services.recognizer.features import NUM_BANDS, LiveMean
from services.recognizer.model_file import (
    Archive,
    topology_arrays,
    topology_from,
    write_archive,
)

NUM_INPUTS = 1 + NUM_BANDS
FORMAT = "neural 1"


@dataclass(frozen=True, slots=True, kw_only=True)
class NeuralModel:
    """A network with its front end; implements ``AcousticModel``."""

    topology: Topology
    weights: tuple[NDArray[np.float32], ...]  # of each layer, (in, out)
    biases: tuple[NDArray[np.float32], ...]  # of each layer, (out,)
    log_prior: NDArray[np.float32]  # (states,)
    frame_offsets: NDArray[np.int64]  # frames that the network sees, relative to the present one
    prior_mean: NDArray[np.float32]  # (41,) mean of the training corpus
    spread: NDArray[np.float32]  # (41,) standard deviation of the training corpus
    kappa: float

    def stream(self) -> NeuralStream:
        """Start a stream of scores for one speaker."""
        return NeuralStream(self)

    def save(self, path: Path) -> None:
        """Write the model as an npz file (arrays only, no pickle)."""
        arrays = {
            "format": np.array(FORMAT),
            **topology_arrays(self.topology),
            "log_prior": self.log_prior,
            "frame_offsets": self.frame_offsets,
            "prior_mean": self.prior_mean,
            "spread": self.spread,
            "kappa": np.array(self.kappa, np.float32),
        }
        for number, (weights, biases) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weights_{number}"] = weights.astype(np.float16)
            arrays[f"biases_{number}"] = biases
        write_archive(path, arrays)


class NeuralStream:
    """Scores of one speaker's speech, segment by segment."""

    def __init__(self, model: NeuralModel) -> None:
        self._model = model
        self._mean = LiveMean(model.prior_mean)
        self.look_ahead_frames = int(model.frame_offsets[-1])
        self._begin()

    def _begin(self) -> None:
        # Frames still needed; before the first frame stands that frame again.
        self._frames = np.empty((0, NUM_INPUTS), dtype=np.float32)

    def accept(self, log_mel: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take log-mel frames, shape (n, 41); return the scores ready, (m, states)."""
        if len(log_mel) == 0:
            return np.empty((0, self._model.topology.num_states), dtype=np.float32)
        frames = self._mean.normalise(log_mel) / self._model.spread
        if len(self._frames) == 0:
            past = -int(self._model.frame_offsets[0])
            self._frames = np.repeat(frames[:1], past, axis=0)
        self._frames = np.concatenate([self._frames, frames])
        return self._score()

    def finish(self) -> NDArray[np.float32]:
        """End the segment: return the scores still owed. The mean is kept for the next one."""
        if len(self._frames) == 0:
            return np.empty((0, self._model.topology.num_states), dtype=np.float32)
        last = np.repeat(self._frames[-1:], self.look_ahead_frames, axis=0)
        self._frames = np.concatenate([self._frames, last])
        scores = self._score()
        self._begin()
        return scores

    def reset(self) -> None:
        """Forget the segment and the speaker."""
        self._begin()
        self._mean.reset()

    def _score(self) -> NDArray[np.float32]:
        """Score the frames whose whole stretch is there and drop what is no longer needed."""
        model = self._model
        offsets = model.frame_offsets - model.frame_offsets[0]
        num_ready = max(0, len(self._frames) - int(offsets[-1]))
        scores = np.empty((num_ready, model.topology.num_states), dtype=np.float32)
        for row in range(num_ready):  # row by row: a product's rounding depends on its height
            hidden = self._frames[row + offsets].reshape(-1)
            scores[row] = network_scores(hidden, model)
        self._frames = self._frames[num_ready:]
        return scores


def network_scores(inputs: NDArray[np.float32], model: NeuralModel) -> NDArray[np.float32]:
    """Log scores of states: inputs (..., frames * 41) to (..., states)."""
    hidden = inputs
    for weights, biases in zip(model.weights[:-1], model.biases[:-1], strict=True):
        hidden = np.maximum(hidden @ weights + biases, 0)
    logits = hidden @ model.weights[-1] + model.biases[-1]
    logits -= logits.max(axis=-1, keepdims=True)
    log_share = logits - np.log(np.exp(logits).sum(axis=-1, keepdims=True))
    scores: NDArray[np.float32] = np.float32(model.kappa) * (log_share - model.log_prior)
    return scores


def neural_from(archive: Archive) -> NeuralModel:
    """Build the model after checking every size; ValueError says what does not fit."""
    topology = topology_from(archive)
    offsets = archive.array("frame_offsets", None).astype(np.int64)
    if offsets.ndim != 1 or not 1 <= len(offsets) <= 100 or (np.diff(offsets) < 1).any():
        raise ValueError("frame offsets do not go upwards")
    if offsets[0] > 0 or offsets[-1] < 0 or offsets[-1] - offsets[0] > 500:
        raise ValueError("frame offsets do not include the present frame")
    weights: list[NDArray[np.float32]] = []
    biases: list[NDArray[np.float32]] = []
    width = len(offsets) * NUM_INPUTS
    while f"weights_{len(weights)}" in archive:
        name = f"_{len(weights)}"
        out = archive.array(f"biases{name}", None).size
        weights.append(archive.floats(f"weights{name}", width, out))
        biases.append(archive.floats(f"biases{name}", out))
        width = out
    if not weights or width != topology.num_states:
        raise ValueError("the last layer does not fit the states")
    spread = archive.floats("spread", NUM_INPUTS)
    if (spread <= 0).any():
        raise ValueError("spread is not positive")
    return NeuralModel(
        topology=topology,
        weights=tuple(weights),
        biases=tuple(biases),
        log_prior=archive.floats("log_prior", topology.num_states),
        frame_offsets=offsets,
        prior_mean=archive.floats("prior_mean", NUM_INPUTS),
        spread=spread,
        kappa=float(archive.floats("kappa")),
    )
