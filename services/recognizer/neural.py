"""Neural acoustic model: a recurrent network over log-mel frames, run by onnxruntime.

Sources: Cho et al. 2014, "Learning phrase representations using RNN encoder-decoder" (gated
recurrent units); Sak et al. 2015, "Fast and accurate recurrent neural network acoustic models for
speech recognition" (scores that come some frames late instead of a look into the future); Bourlard
and Morgan 1994, "Connectionist speech recognition" (scores divided by the states' prior). Units,
HMMs, search and output rule stay those of Li et al. 2011.

======== ============================================================== ===================
symbol   meaning                                                        shape
======== ============================================================== ===================
x        normalised log energy and log-mel bands of the last frames     (frames, batch, 205)
h1, h2   states of both recurrent layers, all networks side by side     (1, batch, H)
p        log share of each state d frames ago                           (frames, batch, states)
d        look-ahead                                                     1
prior    share of a state in the training data, to a power below one    (states,)
kappa    scale of the log scores, chosen on development data            1
======== ============================================================== ===================

    log b(x) = kappa * (p - log prior)

One network serves several look-aheads, each with an output layer of its own. Many sessions share
one call. Every product has at least two rows, because a product with a single row is summed in
another order: so a session's scores are the same to the last bit, whoever is heard along with it
and however its sound is cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from services.recognizer.acoustic_model import Topology, Work
from services.recognizer.features import HOP_S, NUM_BANDS, LiveMean
from services.recognizer.model_file import (
    Archive,
    topology_arrays,
    topology_from,
    write_archive,
)
from shared.errors import UserError

FORMAT = "neural 3"
NUM_INPUTS = 1 + NUM_BANDS
_LEAST_BATCH = 2
_MOST_LOOK_AHEAD = 100  # feature frames
_MOST_WIDTH = 4096


@dataclass(frozen=True, kw_only=True)
class NeuralModel:
    """A network with its front end; implements ``AcousticModel``."""

    topology: Topology
    network: NDArray[np.uint8]  # an ONNX file
    look_aheads: NDArray[np.int64]  # feature frames, of each output layer
    log_prior: NDArray[np.float32]  # (states,)
    prior_mean: NDArray[np.float32]  # (41,) mean of the training corpus
    spread: NDArray[np.float32]  # (41,) standard deviation of the training corpus
    kappa: float
    head: int = 0  # the output layer in use

    @property
    def look_ahead_frames(self) -> int:
        """Look-ahead in use."""
        return int(self.look_aheads[self.head])

    @cached_property
    def session(self) -> onnxruntime.InferenceSession:
        """The network, ready to run on one thread."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        return onnxruntime.InferenceSession(
            self.network.tobytes(), options, providers=["CPUExecutionProvider"]
        )

    @cached_property
    def num_context(self) -> int:
        """Frames that the first layer sees."""
        return int(self.session.get_inputs()[0].shape[2]) // NUM_INPUTS

    @cached_property
    def hidden_shape(self) -> tuple[int, int]:
        """Widths of the recurrent layers."""
        _, first, second, _ = (node.shape for node in self.session.get_inputs())
        return int(first[2]), int(second[2])

    def stream(self) -> NeuralStream:
        """Start a stream of scores for one speaker."""
        return NeuralStream(self)

    def score(self, work: Sequence[Work]) -> list[NDArray[np.float32]]:
        """Score frames of several streams together; None ends a stream's segment."""
        streams = [cast(NeuralStream, stream) for stream, _ in work]
        pieces = [stream.take(log_mel) for stream, (_, log_mel) in zip(streams, work, strict=True)]
        rows: list[list[NDArray[np.float32]]] = [[] for _ in work]
        states = [stream.hidden for stream in streams]
        position = 0
        while left := [number for number, piece in enumerate(pieces) if len(piece) > position]:
            end = min(len(pieces[number]) for number in left)
            batch = (left * _LEAST_BATCH)[:_LEAST_BATCH] if len(left) < _LEAST_BATCH else left
            inputs = np.stack([pieces[number][position:end] for number in batch], axis=1)
            first = np.stack([states[number][0] for number in batch])[None]
            second = np.stack([states[number][1] for number in batch])[None]
            shares, first, second = self.session.run(
                None, {"x": inputs, "h1": first, "h2": second, "head": np.array(self.head)}
            )
            for row, number in enumerate(left):
                rows[number].append(shares[:, row])
                states[number] = (first[0, row], second[0, row])
            position = end
        scores = []
        for number, stream in enumerate(streams):
            stream.hidden = states[number]
            none = np.empty((0, len(self.log_prior)), np.float32)
            shares = stream.drop_early(np.concatenate([none, *rows[number]]))
            scores.append(np.float32(self.kappa) * (shares - self.log_prior))
            if work[number][1] is None:
                stream.begin()
        return scores

    def with_look_ahead(self, look_ahead_ms: float) -> NeuralModel:
        """Return the model with another look-ahead.

        Raises
        ------
        UserError
            If the network was not trained for it.
        """
        offered = [float(frames * HOP_S * 1000) for frames in self.look_aheads]
        if look_ahead_ms not in offered:
            known = ", ".join(f"{one:g}" for one in offered)
            raise UserError(f"recognizer.look_ahead_ms is {look_ahead_ms:g}; give one of {known}")
        return replace(self, head=offered.index(look_ahead_ms))

    def save(self, path: Path) -> None:
        """Write the model as an npz file (arrays only, no pickle)."""
        arrays = {
            "format": np.array(FORMAT),
            **topology_arrays(self.topology),
            "network": self.network,
            "look_aheads": self.look_aheads,
            "log_prior": self.log_prior,
            "prior_mean": self.prior_mean,
            "spread": self.spread,
            "kappa": np.array(self.kappa, np.float32),
            "head": np.array(self.head),
        }
        write_archive(path, arrays)


class NeuralStream:
    """Scores of one speaker's speech, segment by segment."""

    def __init__(self, model: NeuralModel) -> None:
        self._model = model
        self._mean = LiveMean(model.prior_mean)
        self.look_ahead_frames = model.look_ahead_frames
        self.begin()

    def begin(self) -> None:
        """Forget the segment; the speaker's mean stays."""
        first, second = self._model.hidden_shape
        self.hidden = (np.zeros(first, np.float32), np.zeros(second, np.float32))
        self._context: NDArray[np.float32] | None = None  # the last frames, (frames, 41)
        self._num_early = self.look_ahead_frames  # scores to come that are of no frame

    def accept(self, log_mel: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take log-mel frames, shape (n, 41); return the scores ready, (m, states)."""
        return self._model.score([(self, log_mel)])[0]

    def finish(self) -> NDArray[np.float32]:
        """End the segment: return the scores still owed. The mean is kept for the next one."""
        return self._model.score([(self, None)])[0]

    def reset(self) -> None:
        """Forget the segment and the speaker."""
        self.begin()
        self._mean.reset()

    def take(self, log_mel: NDArray[np.float32] | None) -> NDArray[np.float32]:
        """Return what the network is to see, shape (n, 205).

        Before a segment's first frame and, when it ends (None), after its last one stands that
        frame again.
        """
        num_context = self._model.num_context
        if log_mel is not None:
            frames = self._mean.normalise(log_mel) / self._model.spread
        elif self._context is not None:
            frames = np.repeat(self._context[-1:], self.look_ahead_frames, axis=0)
        if (log_mel is None and self._context is None) or len(frames) == 0:
            return np.empty((0, num_context * NUM_INPUTS), dtype=np.float32)
        if self._context is None:
            self._context = np.repeat(frames[:1], num_context - 1, axis=0)
        known = np.concatenate([self._context, frames])
        self._context = known[len(known) - num_context + 1 :]
        at = np.arange(len(frames))[:, None] + np.arange(num_context)
        seen: NDArray[np.float32] = known[at].reshape(len(frames), -1)
        return seen

    def drop_early(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Leave out the rows that a segment begins with, which belong to frames before it."""
        num_early = min(self._num_early, len(rows))
        self._num_early -= num_early
        return rows[num_early:]


def neural_from(archive: Archive) -> NeuralModel:
    """Build the model after checking every size; ValueError says what does not fit."""
    topology = topology_from(archive)
    look_aheads = archive.array("look_aheads", None).astype(np.int64)
    if look_aheads.ndim != 1 or not len(look_aheads):
        raise ValueError("it names no look-aheads")
    if look_aheads.min() < 0 or look_aheads.max() > _MOST_LOOK_AHEAD:
        raise ValueError(f"look-aheads {look_aheads.tolist()}")
    head = int(archive.array("head", ()))
    if not 0 <= head < len(look_aheads):
        raise ValueError(f"output layer {head} of {len(look_aheads)}")
    spread = archive.floats("spread", NUM_INPUTS)
    if (spread <= 0).any():
        raise ValueError("spread is not positive")
    model = NeuralModel(
        topology=topology,
        network=archive.array("network", None).astype(np.uint8),
        look_aheads=look_aheads,
        log_prior=archive.floats("log_prior", topology.num_states),
        prior_mean=archive.floats("prior_mean", NUM_INPUTS),
        spread=spread,
        kappa=float(archive.floats("kappa")),
        head=head,
    )
    _check_network(model)
    return model


def _check_network(model: NeuralModel) -> None:
    try:
        inputs = {node.name: node.shape for node in model.session.get_inputs()}
    except Exception as error:  # onnxruntime's errors have no base of their own
        raise ValueError(f"its network cannot be read ({error})") from error
    if list(inputs) != ["x", "h1", "h2", "head"]:
        raise ValueError(f"its network has the inputs {', '.join(inputs)}")
    widths = (inputs["x"][-1], inputs["h1"][-1], inputs["h2"][-1])
    if not all(isinstance(width, int) and 1 <= width <= _MOST_WIDTH for width in widths):
        raise ValueError(f"its network has inputs of the widths {widths}")
    if widths[0] % NUM_INPUTS:
        raise ValueError(f"its network sees {widths[0]} numbers, no whole number of frames")
    expected = (1, _LEAST_BATCH, model.topology.num_states)
    for head in range(len(model.look_aheads)):
        frames, first, second = (np.zeros((1, _LEAST_BATCH, n), np.float32) for n in widths)
        feeds = {"x": frames, "h1": first, "h2": second, "head": np.array(head)}
        try:
            shares = model.session.run(None, feeds)[0]
        except Exception as error:
            raise ValueError(f"its network does not run ({error})") from error
        if shares.shape != expected or not np.isfinite(shares).all():
            raise ValueError(f"its network scores {shares.shape}, expected {expected}")
