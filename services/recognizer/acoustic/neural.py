"""Neural acoustic model: a causal transformer, run by onnxruntime.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
layers of Whisper's encoder); Vaswani et al. 2017, "Attention is all you need" (sinusoidal
positions); Sak et al. 2015, "Fast and accurate recurrent neural network acoustic models for speech
recognition" (a look-ahead is a delay of the output); Bourlard and Morgan 1994, "Connectionist
speech recognition" (scores are posteriors divided by priors). HMMs, search and output rule are
those of Li et al. 2011.

================ ====================================================== ========================
symbol           meaning                                                shape
================ ====================================================== ========================
x                log-mel bands of the five frames at a position         (rows, 400)
K, V             keys and values of the 127 positions before it, for    (sessions, heads, 128,
                 each layer; the last slot is for the position itself   size)
y                log posteriors of the states at two frames             (rows, 2, states)
d                look-ahead, feature frames, 1 or more                  1
prior            prior of the states, to a power below one              (states,)
acoustic_scale   weight of the log scores, chosen on development data   1
================ ====================================================== ========================

    log b(x) = acoustic_scale * (y - log prior)

There is a position for every other frame. Position ``p`` of a segment has received the frames up to
``2 p + 2`` (zeros precede the first frame). It scores the frames ``2 p + 2 - d`` and
``2 p + 3 - d``. With ``d = 1`` no position scores frame 0, so it gets the scores of frame 1. At the
end of a segment, the last frame is repeated until all frames are scored.

A position attends to itself and to the ``WINDOW - 1`` positions before it, 2.5 seconds. The table
of positions ends after 30 seconds. Longer speech without a pause starts again at the first row,
with an empty past.

One network serves several look-aheads, each with its own output layer. Many sessions share one
call. A matrix product with a single row may be summed in another order, so every product has at
least two rows. A session's scores are therefore the same to the last bit in any batch and any
chunking. The caches of keys and values are rings, because attention does not depend on their order.
They take 1 MB per speaking session, in 16 bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticStream,
    Floats,
    NetworkPosition,
    Work,
    empty_scores,
)
from kouxing.services.recognizer.acoustic.caches import CacheMemory, Float16, cache_names
from kouxing.services.recognizer.acoustic.model_file import Archive, topology_from, write_model
from kouxing.services.recognizer.acoustic.network import (
    MAX_POSITIONS,
    NUM_INPUTS,
    SEEN_FRAMES,
    WINDOW,
    NetworkModel,
    NetworkRunner,
    check_outputs,
    past_masks,
    position_table,
)
from kouxing.services.recognizer.front_end.features import HOP_S
from kouxing.shared.errors import UserError

FORMAT = "neural 6"

_PAST = WINDOW - 1
_PADDING = 2  # frames of zeros before a segment's first
_MIN_ROWS = 2  # in a run
_MAX_BATCH = 16  # sessions in a run; more do not lower the time per session
_MAX_LOOK_AHEAD = 100  # feature frames
_PAST_MASKS = past_masks()


@dataclass(frozen=True, kw_only=True)
class NeuralModel(NetworkModel):
    """A causal network with its look-aheads."""

    look_aheads: NDArray[np.int64]  # feature frames, of each output layer
    output_layer: int = 0  # the one in use

    @property
    def look_ahead_frames(self) -> int:
        """Look-ahead in use."""
        return int(self.look_aheads[self.output_layer])

    @cached_property
    def session(self) -> NetworkRunner:
        """The network, ready to run."""
        return NetworkRunner(self.network)

    @cached_property
    def caches(self) -> CacheMemory:
        """Keys and values of all sessions."""
        return CacheMemory(self.session.sizes.cache, _MAX_BATCH)

    @cached_property
    def positions(self) -> Floats:
        """Table of positions, shape (1500, width)."""
        return position_table(self.session.sizes.width)

    def create_stream(self, *, keep_positions: bool = False) -> NeuralStream:
        """Create the stream of one speaker."""
        return NeuralStream(self, keep_positions=keep_positions)

    def score(self, work: Sequence[Work]) -> list[Floats]:
        """Score frames of several streams in batches; None ends a stream's segment.

        The streams advance in step, one position at a time.
        """
        streams = [cast(NeuralStream, stream) for stream, _ in work]
        for stream, (_, frames) in zip(streams, work, strict=True):
            stream.append_frames(frames)
        while ready := [stream for stream in streams if stream.num_pending]:
            for numbers, rings in self.caches.runs([stream.cache for stream in ready]):
                self._advance([ready[number] for number in numbers], rings)
        scores = []
        for stream, (_, frames) in zip(streams, work, strict=True):
            rows = stream.take_log_posteriors(is_end=frames is None)
            scores.append(self.scores_of(rows))
            if frames is None:
                stream.reset()
        return scores

    def _advance(self, streams: Sequence[NeuralStream], rings: Float16) -> None:
        log_posteriors, keys, values = self.run(streams, rings, self.output_layer)
        new = np.concatenate([keys, values], axis=1)
        for row, stream in enumerate(streams):
            rings[:, row, :, stream.slot] = new[row]
            stream.append_outputs(log_posteriors[row], values[row])

    def run(
        self, streams: Sequence[NeuralStream], rings: Float16, output_layer: int
    ) -> list[Floats]:
        """Run the network at the next position of every stream, with one of its output layers.

        ``rings`` are the streams' caches, (2 layers, sessions, heads, 128, size). Returns log
        posteriors, (rows, 2, states), and keys and values, (rows, layers, heads, size); the first
        rows are those of the streams.
        """
        rows = [*streams, streams[0]] if len(streams) < _MIN_ROWS else streams
        inputs: dict[str, NDArray[Any]] = {
            "frames": np.stack([stream.next_frames() for stream in rows]),
            "position": self.positions[[stream.position for stream in rows]],
            "output_layer": np.array(output_layer),
            "past_mask": _PAST_MASKS[[min(stream.position, _PAST) for stream in streams]],
        }
        caches = dict(zip(cache_names(self.session.sizes.num_layers), rings, strict=True))
        return self.session.run({**inputs, **caches})

    def with_look_ahead(self, look_ahead_ms: float) -> NeuralModel:
        """Return the model with a look-ahead; ``UserError`` if it was not trained with it."""
        offered = [float(frames * HOP_S * 1000) for frames in self.look_aheads]
        if look_ahead_ms not in offered:
            choices = ", ".join(f"{choice:g}" for choice in offered)
            raise UserError(
                f"the neural model has no look-ahead of {look_ahead_ms:g} ms; choose {choices}"
            )
        model = replace(self, output_layer=offered.index(look_ahead_ms))
        vars(model)["session"] = self.session  # opened once for all look-aheads
        return model

    def save(self, path: Path) -> None:
        """Write the model as an npz file (arrays only, no pickle)."""
        write_model(
            path,
            FORMAT,
            self.topology,
            network=self.network,
            look_aheads=self.look_aheads,
            log_prior=self.log_prior,
            acoustic_scale=self.acoustic_scale,
            output_layer=self.output_layer,
        )


class NeuralStream(AcousticStream):
    """Scores and positions of one speaker's speech, segment by segment."""

    _model: NeuralModel

    def __init__(self, model: NeuralModel, *, keep_positions: bool) -> None:
        super().__init__(model)
        self._keep_positions = keep_positions
        self.look_ahead_frames = model.look_ahead_frames
        self.cache = model.caches.open()  # what lies beyond a segment's positions is masked
        self.reset()

    def reset(self) -> None:
        """Forget the segment. The network has no memory of the speaker."""
        self._frames = np.zeros((_PADDING, NUM_INPUTS), np.float32)  # from the next position on
        self._num_frames = 0
        self._num_scored = 0
        self._num_positions = 0  # computed
        self._rows: list[Floats] = []  # log posteriors not yet returned, one array per frame

    @property
    def num_pending(self) -> int:
        """Number of positions that have all their frames."""
        return max(0, (len(self._frames) - SEEN_FRAMES) // 2 + 1)

    @property
    def position(self) -> int:
        """Row of the next position in the table."""
        return self._num_positions % MAX_POSITIONS

    @property
    def slot(self) -> int:
        """Place of the next position in the cache."""
        return self.position % _PAST

    def append_frames(self, frames: Floats | None) -> None:
        """Append frames; None, the end of the segment, repeats the last frame as needed."""
        if frames is None:
            num_more = self._num_missing() if self._num_frames else 0
            frames = np.repeat(self._frames[-1:], num_more, axis=0)
        else:
            self._num_frames += len(frames)
        self._frames = np.concatenate([self._frames, frames])

    def _num_missing(self) -> int:
        """Count the frames that are still needed to score all frames so far."""
        last = max(0, math.ceil((self._num_frames + self.look_ahead_frames) / 2) - 2)  # position
        num_seen = 2 * self._num_positions - _PADDING + len(self._frames)
        return max(0, 2 * last + _PADDING + 1 - num_seen)

    def next_frames(self) -> Floats:
        """Return the frames at the next position, shape (400,)."""
        return self._frames[:SEEN_FRAMES].reshape(-1)

    def append_outputs(self, log_posteriors: Floats, values: Floats) -> None:
        """Append log posteriors, (2, states), and values, (layers, heads, size), of a position."""
        first = 2 * self._num_positions + _PADDING - self.look_ahead_frames
        if first == 1 and self._num_positions == 0:
            self._rows.append(log_posteriors[0])  # frame 0, which no position scores
        self._rows += [row for number, row in enumerate(log_posteriors) if first + number >= 0]
        if self._keep_positions:
            newest = self._frames[SEEN_FRAMES - 2 : SEEN_FRAMES]
            self.positions.append(NetworkPosition(newest, values))
        self._num_positions += 1
        self._frames = self._frames[2:]

    def take_log_posteriors(self, *, is_end: bool) -> Floats:
        """Return the new log posteriors, (m, states); at the end those of all remaining frames."""
        rows = self._rows[: self._num_frames - self._num_scored] if is_end else self._rows
        self._num_scored += len(rows)
        self._rows = []
        return np.stack(rows) if rows else empty_scores(len(self._model.log_prior))


def neural_model_from(archive: Archive) -> NeuralModel:
    """Build the model after checking every size; ``ValueError`` if something does not fit."""
    topology = topology_from(archive)
    look_aheads = archive.array("look_aheads", None).astype(np.int64)
    if look_aheads.ndim != 1 or not len(look_aheads):
        raise ValueError("it has no look-aheads")
    if look_aheads.min() < 1 or look_aheads.max() > _MAX_LOOK_AHEAD:
        raise ValueError(f"its look-aheads are {look_aheads.tolist()}")
    output_layer = int(archive.array("output_layer", ()))
    if not 0 <= output_layer < len(look_aheads):
        raise ValueError(f"it has no output layer {output_layer}, only {len(look_aheads)}")
    model = NeuralModel(
        topology=topology,
        network=archive.array("network", None).astype(np.uint8),
        look_aheads=look_aheads,
        log_prior=archive.floats("log_prior", topology.num_states),
        acoustic_scale=float(archive.floats("acoustic_scale")),
        output_layer=output_layer,
    )
    sizes = model.session.sizes
    stream = model.create_stream()
    stream.append_frames(np.zeros((SEEN_FRAMES - _PADDING, NUM_INPUTS), np.float32))
    cached = (_MIN_ROWS, sizes.num_layers, sizes.num_heads, sizes.head_size)
    expected = [(_MIN_ROWS, 2, model.topology.num_states), cached, cached]
    for number in range(len(look_aheads)):
        check_outputs(model.run([stream], stream.cache.rings[:, None], number), expected)
    return model
