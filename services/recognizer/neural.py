"""Neural acoustic model: a transformer that hears only the past, run by onnxruntime.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (Whisper:
the encoder's layers); Vaswani et al. 2017, "Attention is all you need" (sinusoidal positions); Sak
et al. 2015, "Fast and accurate recurrent neural network acoustic models for speech recognition"
(scores that come some frames late instead of a look into the future); Bourlard and Morgan 1994,
"Connectionist speech recognition" (scores divided by the states' prior). Units, HMMs, search and
output rule stay those of Li et al. 2011.

======== ============================================================== ===================
symbol   meaning                                                        shape
======== ============================================================== ===================
x        log-mel bands of the five frames that a position sees          (batch, 400)
K, V     keys and values of the 127 positions before it, and zeros      (batch, heads, 128,
         in the last place, which the position itself takes; one of     size), K turned
         each for every layer
y        log shares of the states at two frames                         (batch, 2, states)
d        look-ahead, 1 or more                                          1
prior    share of a state in the training data, to a power below one    (states,)
kappa    scale of the log scores, chosen on development data            1
======== ============================================================== ===================

    log b(x) = kappa * (y - log prior)

There is a position for every other frame. Position ``p`` of a segment has heard the frames up to
``2 p + 2`` (before the first stand frames of zeros) and says frames ``2 p + 2 - d`` and
``2 p + 3 - d``. With ``d = 1`` no position says frame 0: it is given the scores of frame 1. When
the segment ends, its last frame is repeated until all frames have been said.

A position attends to itself and to the ``WINDOW - 1`` before it, 2.5 seconds. The table of
positions ends after 30 seconds: speech that long without a pause goes on as if it began there, with
an empty past.

One network serves several look-aheads, each with an output layer of its own. Many sessions share
one call. Every product of rows has at least two of them, because a product with a single row may be
summed in another order: so a session's scores are the same to the last bit, whoever is heard along
with it and however its sound is cut. Keys and values lie in rings: attention does not ask for their
order.

Cost: about 90 ms of one core of 2020 for a second of sound; 40 ms each when 16 sessions are heard
together. A session's keys and values take 2 MB.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from services.recognizer.acoustic_model import Topology, Work
from services.recognizer.features import HOP_S
from services.recognizer.model_file import (
    Archive,
    topology_arrays,
    topology_from,
    write_archive,
)
from services.recognizer.whisper_mel import NUM_MELS, WhisperMel
from shared.errors import UserError

FORMAT = "neural 4"
NUM_INPUTS = NUM_MELS
WINDOW = 128  # positions that one attends to, itself included
MOST_POSITIONS = 1500  # in the table of positions
SEEN_FRAMES = 5  # by one position

_PAST = WINDOW - 1
_BEFORE = 2  # frames of zeros before a segment's first
_LEAST_BATCH = 2
_MOST_LOOK_AHEAD = 100  # feature frames
_LEAST_WIDTH, _MOST_WIDTH = 4, 4096
_MOST_LAYERS = 64
_LONGEST_WAVE = 10_000.0  # of the sinusoids, over 2 pi

Floats = NDArray[np.float32]


def positions_of(width: int) -> Floats:
    """Whisper's table of sinusoidal positions, shape (1500, width)."""
    step = math.log(_LONGEST_WAVE) / (width // 2 - 1)
    phase = np.arange(MOST_POSITIONS)[:, None] * np.exp(-step * np.arange(width // 2))
    return np.concatenate([np.sin(phase), np.cos(phase)], axis=1).astype(np.float32)


def _past_masks() -> Floats:
    """Return what is added to products with a ring's keys, by the number of positions in it."""
    place = np.arange(WINDOW)
    is_empty = (place >= np.arange(WINDOW)[:, None]) & (place < _PAST)
    return np.where(is_empty, np.float32(-np.inf), np.float32(0))[:, None, None]


_PAST_MASKS = _past_masks()  # (128, 1, 1, 128)


@dataclass(frozen=True, slots=True)
class NetworkSizes:
    """Sizes that the network's inputs tell."""

    width: int
    layers: int
    heads: int
    size: int  # of a key or value


def input_names(layers: int) -> list[str]:
    """Names of the network's inputs, in order."""
    caches = [f"{kind}_{layer}" for kind in ("keys", "values") for layer in range(layers)]
    return ["frames", "place", "head", "past", *caches]


@dataclass(frozen=True, kw_only=True)
class NeuralModel:
    """A network with its front end; implements ``AcousticModel``."""

    topology: Topology
    network: NDArray[np.uint8]  # an ONNX file
    look_aheads: NDArray[np.int64]  # feature frames, of each output layer
    log_prior: Floats  # (states,)
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
    def sizes(self) -> NetworkSizes:
        """Sizes of the network."""
        shapes = {node.name: node.shape for node in self.session.get_inputs()}
        _, heads, size, _ = shapes["keys_0"]
        layers = sum(name.startswith("keys_") for name in shapes)
        return NetworkSizes(shapes["place"][1], layers, heads, size)

    @cached_property
    def positions(self) -> Floats:
        """Table of positions, shape (1500, width)."""
        return positions_of(self.sizes.width)

    def front_end(self) -> WhisperMel:
        """Start a front end for one session."""
        return WhisperMel()

    def stream(self) -> NeuralStream:
        """Start a stream of scores for one speaker."""
        return NeuralStream(self)

    def score(self, work: Sequence[Work]) -> list[Floats]:
        """Score frames of several streams together; None ends a stream's segment.

        The streams go on position by position, in step.
        """
        streams = [cast(NeuralStream, stream) for stream, _ in work]
        for stream, (_, frames) in zip(streams, work, strict=True):
            stream.take(frames)
        while going := [stream for stream in streams if stream.num_pending]:
            going.sort(key=lambda stream: (id(stream.rings), stream.row))
            shares, keys, values = self.run(going, self.head)
            for row, stream in enumerate(going):
                stream.put(shares[row], keys[row], values[row])
        scores = []
        for stream, (_, frames) in zip(streams, work, strict=True):
            rows = stream.said(is_end=frames is None)
            scores.append(np.float32(self.kappa) * (rows - self.log_prior))
            if frames is None:
                stream.begin()
        return scores

    def run(self, streams: Sequence[NeuralStream], head: int) -> list[Floats]:
        """Run the network at the next position of every stream, with one of its output layers.

        Returns
        -------
        list
            Log shares, (rows, 2, states), keys and values, (rows, layers, heads, size); the first
            rows are those of the streams.
        """
        rings = _rings_of(streams)
        rows = [*streams, streams[0]] if len(streams) < _LEAST_BATCH else streams
        inputs = {
            "frames": np.stack([stream.seen() for stream in rows]),
            "place": self.positions[[stream.place for stream in rows]],
            "head": np.array(head),
            "past": _PAST_MASKS[[min(stream.place, _PAST) for stream in streams]],
        }
        for layer, (keys, values) in enumerate(zip(rings.keys, rings.values, strict=True)):
            inputs[f"keys_{layer}"] = keys
            inputs[f"values_{layer}"] = values
        found: list[Floats] = self.session.run(["shares", "keys", "values"], inputs)
        return found

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
        model = replace(self, head=offered.index(look_ahead_ms))
        vars(model)["session"] = self.session  # made once
        return model

    def save(self, path: Path) -> None:
        """Write the model as an npz file (arrays only, no pickle)."""
        arrays = {
            "format": np.array(FORMAT),
            **topology_arrays(self.topology),
            "network": self.network,
            "look_aheads": self.look_aheads,
            "log_prior": self.log_prior,
            "kappa": np.array(self.kappa, np.float32),
            "head": np.array(self.head),
        }
        write_archive(path, arrays)


class _Rings:
    """Keys and values of some sessions' earlier positions, as the network takes them.

    A layer's keys stand upright: so a product with a row runs along the positions.
    """

    def __init__(self, sizes: NetworkSizes, num_sessions: int) -> None:
        layers, heads, size = sizes.layers, sizes.heads, sizes.size
        self.keys = np.zeros((layers, num_sessions, heads, size, WINDOW), np.float32)
        self.values = np.zeros((layers, num_sessions, heads, WINDOW, size), np.float32)


def _rings_of(streams: Sequence[NeuralStream]) -> _Rings:
    """Return rings whose rows are the streams' keys and values, in order.

    Streams that go on together, as they mostly do, keep theirs together: nothing is copied.
    """
    rings = streams[0].rings
    if rings.keys.shape[1] == len(streams) and all(
        stream.rings is rings and stream.row == row for row, stream in enumerate(streams)
    ):
        return rings
    rings = _Rings(streams[0].sizes, len(streams))
    for row, stream in enumerate(streams):
        rings.keys[:, row] = stream.rings.keys[:, stream.row]
        rings.values[:, row] = stream.rings.values[:, stream.row]
    for row, stream in enumerate(streams):
        stream.rings, stream.row = rings, row
    return rings


class NeuralStream:
    """Scores of one speaker's speech, segment by segment."""

    def __init__(self, model: NeuralModel) -> None:
        self._model = model
        self.sizes = model.sizes
        self.look_ahead_frames = model.look_ahead_frames
        self.begin()

    def begin(self) -> None:
        """Forget the segment."""
        self._frames = np.zeros((_BEFORE, NUM_INPUTS), np.float32)  # from the next position's first
        self._num_frames = 0  # accepted
        self._num_said = 0
        self._position = 0
        self._rows: list[Floats] = []  # log shares of frames, in order
        self.rings, self.row = _Rings(self.sizes, 1), 0

    def accept(self, frames: Floats) -> Floats:
        """Take frames, shape (n, 80); return the scores ready, (m, states)."""
        return self._model.score([(self, frames)])[0]

    def finish(self) -> Floats:
        """End the segment and return the scores still owed."""
        return self._model.score([(self, None)])[0]

    def reset(self) -> None:
        """Forget the segment and the speaker."""
        self.begin()

    @property
    def num_pending(self) -> int:
        """Positions that can be computed."""
        return max(0, (len(self._frames) - SEEN_FRAMES) // 2 + 1)

    @property
    def place(self) -> int:
        """Row of the next position in the table."""
        return self._position % MOST_POSITIONS

    def take(self, frames: Floats | None) -> None:
        """Take frames, or at the end of the segment (None) the last one again and again."""
        if frames is None:
            num_more = self._num_wanting() if self._num_frames else 0
            frames = np.repeat(self._frames[-1:], num_more, axis=0)
        else:
            self._num_frames += len(frames)
        self._frames = np.concatenate([self._frames, frames])

    def _num_wanting(self) -> int:
        """Frames that must still come so that all frames are said."""
        last = max(0, math.ceil((self._num_frames + self.look_ahead_frames) / 2) - 2)  # position
        num_seen = 2 * self._position - _BEFORE + len(self._frames)
        return max(0, 2 * last + _BEFORE + 1 - num_seen)

    def seen(self) -> Floats:
        """Return the frames that the next position sees, shape (400,)."""
        return self._frames[:SEEN_FRAMES].reshape(-1)

    def put(self, shares: Floats, keys: Floats, values: Floats) -> None:
        """Take what the network says at a position, (2, states), and its keys and values."""
        first = 2 * self._position + _BEFORE - self.look_ahead_frames
        if first == 1 and self._position == 0:
            self._rows.append(shares[0])  # frame 0, which no position says
        self._rows += [row for number, row in enumerate(shares) if first + number >= 0]
        at = self.place % _PAST
        self.rings.keys[:, self.row, :, :, at] = keys
        self.rings.values[:, self.row, :, at] = values
        self._position += 1
        self._frames = self._frames[2:]
        if self.place == 0:  # the end of the table
            self.rings, self.row = _Rings(self.sizes, 1), 0

    def said(self, *, is_end: bool) -> Floats:
        """Return the log shares that are new, (m, states); at the end those of all frames left."""
        rows = self._rows[: self._num_frames - self._num_said] if is_end else self._rows
        self._num_said += len(rows)
        self._rows = []
        return np.stack(rows) if rows else np.empty((0, len(self._model.log_prior)), np.float32)


def neural_from(archive: Archive) -> NeuralModel:
    """Build the model after checking every size; ValueError says what does not fit."""
    topology = topology_from(archive)
    look_aheads = archive.array("look_aheads", None).astype(np.int64)
    if look_aheads.ndim != 1 or not len(look_aheads):
        raise ValueError("it names no look-aheads")
    if look_aheads.min() < 1 or look_aheads.max() > _MOST_LOOK_AHEAD:
        raise ValueError(f"look-aheads {look_aheads.tolist()}")
    head = int(archive.array("head", ()))
    if not 0 <= head < len(look_aheads):
        raise ValueError(f"output layer {head} of {len(look_aheads)}")
    model = NeuralModel(
        topology=topology,
        network=archive.array("network", None).astype(np.uint8),
        look_aheads=look_aheads,
        log_prior=archive.floats("log_prior", topology.num_states),
        kappa=float(archive.floats("kappa")),
        head=head,
    )
    _check_network(model)
    return model


def _check_network(model: NeuralModel) -> None:
    try:
        session = model.session
    except Exception as error:  # onnxruntime's errors have no base of their own
        raise ValueError(f"its network cannot be read ({error})") from error
    _check_inputs({node.name: node.shape for node in session.get_inputs()})
    sizes = model.sizes
    stream = model.stream()
    stream.take(np.zeros((SEEN_FRAMES - _BEFORE, NUM_INPUTS), np.float32))
    own = (_LEAST_BATCH, sizes.layers, sizes.heads, sizes.size)
    expected = [(_LEAST_BATCH, 2, model.topology.num_states), own, own]
    for head in range(len(model.look_aheads)):
        try:
            found = model.run([stream], head)
        except Exception as error:
            raise ValueError(f"its network does not run ({error})") from error
        if [array.shape for array in found] != expected:
            raise ValueError(f"its network scores {found[0].shape}, expected {expected[0]}")
        if not all(np.isfinite(array).all() for array in found):
            raise ValueError("its network scores with values that are no numbers")


def _check_inputs(shapes: Mapping[str, Sequence[object]]) -> None:
    """Check that a network's inputs are those of a position."""
    layers = sum(name.startswith("keys_") for name in shapes)
    if not 1 <= layers <= _MOST_LAYERS or list(shapes) != input_names(layers):
        raise ValueError(f"its network has the inputs {', '.join(shapes)}")
    width, heads, size = shapes["place"][-1], shapes["keys_0"][1], shapes["keys_0"][-2]
    if (
        not (isinstance(width, int) and isinstance(heads, int) and isinstance(size, int))
        or not (_LEAST_WIDTH <= width <= _MOST_WIDTH and width % 2 == 0)
        or not (heads >= 1 and size >= 1 and heads * size <= _MOST_WIDTH)
    ):
        raise ValueError(f"its network has the width {width}, {heads} heads of size {size}")
    sizes = [(SEEN_FRAMES * NUM_INPUTS,), (width,), (), (1, 1, WINDOW)]
    sizes += [(heads, size, WINDOW)] * layers + [(heads, WINDOW, size)] * layers
    for (name, shape), expected in zip(shapes.items(), sizes, strict=True):
        if tuple(shape[1:]) != expected:
            raise ValueError(f"its network has {name} of {shape}, expected {expected} of each")
