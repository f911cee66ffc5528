"""Block model: Whisper's encoder on blocks of speech with a cached past, run by onnxruntime.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
encoder); Shi et al. 2021, "Emformer: efficient memory transformer based acoustic model for low
latency streaming speech recognition" (blocks with a cached past, whose right context is
recomputed); Bourlard and Morgan 1994, "Connectionist speech recognition" (scores are posteriors
divided by priors). HMMs, search and output rule follow Li et al. 2011. The network is defined in
:mod:`kouxing.training.blocks.network`.

============== ====================================================== ========================
symbol         meaning                                                unit, shape
============== ====================================================== ========================
x              log-mel bands, at most eight decades below the         (frames, 80)
               loudest so far
y              log posteriors of the states                           (frames, states)
B, R           encoder frames of a block, and of its right context    encoder frames
H              encoder frames from one run to the next, the hop       encoder frames
PAST           encoder frames before a block that it attends to       encoder frames
prior          prior of the states, to a power below one              (states,)
acoustic_scale weight of the log scores, chosen on development data   1
============== ====================================================== ========================

    log b(x) = acoustic_scale * (y - log prior)

Encoder frame ``p`` of a segment has the feature frames ``2 p`` and ``2 p + 1``. It depends on the
feature frames from ``2 p - 2`` to ``2 p + 2`` (zeros precede the first). Whenever ``H`` more
encoder frames are complete, the network runs on the newest ones, up to ``B + R``. It settles the
scores of the first encoder frames, to make room for ``H`` more in the next run, and keeps their
keys and values. The scores of the others, the right context, are provisional. ``H`` is ``B``, and
on a busy machine a multiple of ``B``: there are fewer runs, and right contexts are shorter. When
speech starts, the first runs have fewer encoder frames and settle none. The last run repeats the
segment's last feature frame once or twice and settles all encoder frames.

The table of positions ends after 30 seconds. Longer speech without a pause starts again at the
first row, with an empty past.

Sessions that settle the same number of encoder frames at the same time share one run. The network
scales and rounds each row of a product separately, so a session's scores are the same to the last
bit in any batch and any chunking. Keys and values are rings, because attention does not depend on
their order. They take 1.5 MB per speaking session, in 16 bits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    AcousticStream,
    ScoreRequest,
)
from kouxing.services.recognizer.acoustic.light import LightModel, build_light_model
from kouxing.services.recognizer.acoustic.model_file import Archive, parse_topology
from kouxing.services.recognizer.acoustic.network import (
    FRAMES_PER_ENCODER_FRAME,
    MAX_POSITIONS,
    check_outputs,
    encode_integer_inputs,
    open_onnx_session,
    position_table,
    run_onnx_session,
)
from kouxing.services.recognizer.front_end.whisper_mel import FLOOR_BANDS, NUM_MELS, WhisperMel
from kouxing.shared.arrays import Float16, Floats, UInt8
from kouxing.shared.fast_record import Record

FORMAT = "blocks 2"


_INPUTS = ["frames", "positions", "num_positions", "num_cached", "state"]  # without the caches
_OUTPUTS = ["log_posteriors", "new_state", "new"]
# Constants of the file that become inputs: the number of kept encoder frames, and the last of them.
_NUM_KEPT, _LAST_KEPT = "block", "last_of_block"
EXTENSION_PREFIX = "universal_"  # starts the names of a second readout's input and outputs
_PADDING = 2  # frames of zeros before a segment's first
_RIGHT_CONTEXT_FRAMES = 2  # feature frames after an encoder frame's first one on which it depends
_MAX_BATCH = 4  # sessions in a run; more need memory and do not lower the time per session
_MAX_SIZE = 4096
_MAX_CACHE_BYTES = 3_000_000  # per session


@dataclass(frozen=True, kw_only=True)
class BlockModel(AcousticModel):
    """The block model: a network that scores speech in blocks."""

    network: UInt8  # an ONNX file
    log_prior: Floats  # (states,)
    acoustic_scale: float

    @cached_property
    def runner(self) -> BlockRunner:
        """The network, opened when the model is loaded."""
        return BlockRunner(self.network)

    @cached_property
    def light_model(self) -> LightModel | None:
        """The model for a busy machine, or None if the encoder has other phones."""
        return build_light_model(self.topology, self.log_prior)

    def create_front_end(self) -> WhisperMel:
        """Create the front end of one session."""
        return WhisperMel()

    def create_stream(self) -> BlockStream:
        """Create the stream of one speaker."""
        return BlockStream(self)

    def score(self, requests: Sequence[ScoreRequest]) -> list[Floats]:
        """Score frames of several streams in batches; None ends a stream's segment."""
        streams = [cast(BlockStream, stream) for stream, _ in requests]
        for stream, (_, frames) in zip(streams, requests, strict=True):
            stream.append_frames(frames)
        while ready := [(stream, stream.block()) for stream in streams if stream.is_due]:
            num_kept = ready[0][1].num_kept
            batch = [(stream, block) for stream, block in ready if block.num_kept == num_kept]
            self._run(batch[:_MAX_BATCH])
        return [stream.take_settled_scores() for stream in streams]

    def _run(self, blocks: Sequence[tuple[BlockStream, Block]]) -> None:
        log_posteriors, states, new_cache = self.runner.run([block for _, block in blocks])
        # posteriors divided by priors (Bourlard and Morgan 1994), weighted
        scores = (log_posteriors - self.log_prior) * np.float32(self.acoustic_scale)
        # copies: a view would keep the whole batch
        for row, (stream, block) in enumerate(blocks):
            stream.append_outputs(block, scores[row].copy(), states[row].copy(), new_cache[row])


@dataclass(frozen=True, slots=True)
class BlockSizes:
    """Sizes of a network, read from its inputs and outputs."""

    block: int  # B
    length: int  # B + R
    past: int  # PAST
    width: int
    state: int  # width of the recurrent layer
    layers: int
    heads: int
    head_size: int

    @property
    def rings(self) -> tuple[int, int, int, int]:
        """Shape of a session's keys of all layers, and then its values."""
        return 2 * self.layers, self.heads, self.past, self.head_size


@dataclass(slots=True)
class NetworkState:
    """A session's network state before a block."""

    state: Floats  # state of the recurrent layer, (width,)
    rings: Float16  # keys and values, (2 layers, heads, PAST, size), finite
    num_cached: int = 0  # encoder frames in the rings


class Block(Record, frozen=True):
    """The next block of one session, with its right context."""

    frames: Floats  # (2 encoder frames + 3, 80), from two before the first encoder frame's
    row: int  # row of the first encoder frame in the table of positions
    num_encoder_frames: int
    num_settled: int  # number of leading encoder frames whose scores are settled
    num_kept: int  # number of leading encoder frames whose keys and values are kept; 0 at the end
    past: NetworkState


class BlockRunner:
    """Runs a block network. Raises ``ValueError`` if the file contains another network."""

    total_run_s: ClassVar[float] = 0.0  # processor time spent in all networks so far

    def __init__(self, file: UInt8) -> None:
        content = file.tobytes()
        # a second readout may have its own constant
        names = (_LAST_KEPT, f"{EXTENSION_PREFIX}{_LAST_KEPT}")
        self._last_kept = [name for name in names if name.encode() in content]
        axes = {_NUM_KEPT: 1, **dict.fromkeys(self._last_kept, 0)}
        self._session = open_onnx_session(file, encode_integer_inputs(axes))
        self.sizes, self._unused_state_width = _read_sizes(self._session)
        self._names = cache_names(self.sizes.layers)
        prefix = EXTENSION_PREFIX if self._unused_state_width else ""
        self._state = f"{prefix}state"
        self._outputs = [f"{prefix}{name}" for name in _OUTPUTS[:2]] + _OUTPUTS[2:]
        unused = np.zeros((self.sizes.length, self.sizes.width), np.float32)
        self._positions = np.concatenate([position_table(self.sizes.width), unused])

    def run(self, blocks: Sequence[Block]) -> tuple[Floats, Floats, Float16]:
        """Run the network on the next blocks of ``n`` sessions, which keep equally many frames.

        Returns log posteriors, (n, 2 (B + R), states), undefined for frames that a block lacks; the
        recurrent layer's state after the kept encoder frames, (n, width); the keys of all layers
        and then the values of the kept ones, (n, 2 layers, heads, kept, size). If no frame is
        kept, the state is undefined.
        """
        length, num_kept = self.sizes.length, max(1, blocks[0].num_kept)
        frames = np.zeros((len(blocks), 2 * length + 3, NUM_MELS), np.float32)
        for row, block in enumerate(blocks):
            frames[row, : len(block.frames)] = block.frames
        inputs = {
            "frames": frames,
            "positions": np.array([self._positions[b.row : b.row + length] for b in blocks]),
            "num_positions": np.array([block.num_encoder_frames for block in blocks]),
            "num_cached": np.array([block.past.num_cached for block in blocks]),
            self._state: np.array([block.past.state for block in blocks]),
            _NUM_KEPT: np.array([num_kept]),
            **dict.fromkeys(self._last_kept, np.array(num_kept - 1)),
        }
        rings = blocks[0].past.rings[:, np.newaxis]
        if len(blocks) > 1:
            rings = np.stack([block.past.rings for block in blocks], axis=1)
        inputs |= zip(self._names, rings, strict=True)
        if self._unused_state_width:  # the unused readout also needs a state
            inputs["state"] = np.zeros((len(blocks), self._unused_state_width), np.float32)
        start_s = time.thread_time()
        log_posteriors, state, new_cache = run_onnx_session(self._session, self._outputs, inputs)
        BlockRunner.total_run_s += time.thread_time() - start_s
        return log_posteriors, state, new_cache


class BlockStream(AcousticStream):
    """Scores of one speaker's speech, segment by segment."""

    model: BlockModel

    def __init__(self, model: BlockModel) -> None:
        super().__init__(model)
        self._sizes = model.runner.sizes
        self.look_ahead_frames = FRAMES_PER_ENCODER_FRAME * self._sizes.length
        self._hop = self._sizes.block  # H
        self._empty_scores = self.provisional
        self._rings = np.zeros(self._sizes.rings, np.float16)
        self.reset()

    def reset(self) -> None:
        """Forget the segment. The network has no memory of the speaker."""
        self.provisional = self._empty_scores
        self._settled: list[Floats] = []  # not yet returned
        self._num_frames = 0  # number of frames in the segment
        self._num_settled = 0
        self._loudest = np.float32(-np.inf)  # band of the segment
        self._frames = np.zeros((_PADDING, NUM_MELS), np.float32)  # starts with the next block
        self._has_ended = False
        self._restart_positions()

    def _restart_positions(self) -> None:
        """Start at the first row of the table of positions, with an empty past."""
        self._row = 0  # table row of the next block
        self._num_due = self._sizes.length % self._sizes.block or self._sizes.block
        self._past = NetworkState(np.zeros(self._sizes.state, np.float32), self._rings)

    def set_hop(self, num_blocks: int) -> None:
        """Set the hop in blocks, from the run after the next one."""
        self._hop = min(num_blocks * self._sizes.block, self._sizes.length)

    def append_frames(self, frames: Floats | None) -> None:
        """Append frames, (n, 80); None, the end of the segment, repeats the last frame."""
        if frames is None:
            self._has_ended = True
            num_more = _RIGHT_CONTEXT_FRAMES - (self._num_frames - 1) % FRAMES_PER_ENCODER_FRAME
            frames = np.repeat(self._frames[-1:], num_more if self._num_frames else 0, axis=0)
        elif len(frames):
            self._num_frames += len(frames)
            loudest = np.maximum(np.maximum.accumulate(frames.max(axis=1)), self._loudest)
            self._loudest = loudest[-1]
            frames = np.maximum(frames, (loudest - np.float32(FLOOR_BANDS))[:, None])
        self._frames = np.concatenate([self._frames, frames])

    @property
    def is_due(self) -> bool:
        """Whether the network must run."""
        num_encoder_frames = self._num_encoder_frames()
        return num_encoder_frames >= self._num_due or (self._has_ended and num_encoder_frames > 0)

    def is_due_after(self, num_frames: int) -> bool:
        """Return whether the network must run after this number of additional frames."""
        return self._num_encoder_frames(num_frames) >= self._num_due

    def _num_encoder_frames(self, num_more: int = 0) -> int:
        """Return the number of complete encoder frames, from the next block's first on."""
        num_frames = len(self._frames) + num_more - 1 - _RIGHT_CONTEXT_FRAMES
        return max(0, num_frames // FRAMES_PER_ENCODER_FRAME)

    def block(self) -> Block:
        """Return the block that the network must compute next."""
        sizes, num_complete = self._sizes, self._num_encoder_frames()
        num_encoder_frames = min(num_complete, self._num_due)
        max_encoder_frames = min(sizes.length, MAX_POSITIONS - self._row)
        if num_encoder_frames < max_encoder_frames:
            # one run replaces several runs that settle nothing
            num_more = min(num_complete, max_encoder_frames) - num_encoder_frames
            num_encoder_frames += num_more // sizes.block * sizes.block
        is_last = self._row + num_encoder_frames == MAX_POSITIONS or (
            self._has_ended and num_encoder_frames == num_complete
        )
        num_kept = 0 if is_last else max(0, num_encoder_frames + self._hop - sizes.length)
        return Block(
            frames=self._frames[: FRAMES_PER_ENCODER_FRAME * num_encoder_frames + _PADDING + 1],
            row=self._row,
            num_encoder_frames=num_encoder_frames,
            num_settled=num_encoder_frames if is_last else num_kept,
            num_kept=num_kept,
            past=self._past,
        )

    def append_outputs(
        self, block: Block, scores: Floats, state: Floats, new_cache: Float16
    ) -> None:
        """Append a block's scores, new state, keys and values; shapes as in ``BlockRunner.run``."""
        past = self._sizes.past
        end = FRAMES_PER_ENCODER_FRAME * block.num_settled
        self._settled.append(scores[:end])
        self.provisional = scores[end : FRAMES_PER_ENCODER_FRAME * block.num_encoder_frames]
        self._frames = self._frames[end:]
        if block.num_settled > block.num_kept:
            self._restart_positions()
            return
        if block.num_kept:
            slots = np.arange(self._row, self._row + block.num_kept) % past
            self._rings[:, :, slots] = new_cache
            self._past.num_cached = min(self._past.num_cached + block.num_kept, past)
            self._past.state = state
            self._row += block.num_kept
        num_due = block.num_encoder_frames - block.num_kept + self._hop
        self._num_due = min(num_due, MAX_POSITIONS - self._row)

    def take_settled_scores(self) -> Floats:
        """Return the new settled scores, (m, states); at the end, of all remaining frames."""
        rows = np.concatenate([self._empty_scores, *self._settled])
        self._settled = []
        self._num_settled += len(rows)
        if self._has_ended:
            rows = rows[: len(rows) - (self._num_settled - self._num_frames)]
            self.reset()
        return rows


def _read_sizes(session: Any) -> tuple[BlockSizes, int]:
    """Read a network's sizes from its inputs and outputs; a run checks the other shapes.

    Also returns the width of the first readout's state if a second readout is used, otherwise 0.
    """
    shapes = {node.name: list(node.shape[1:]) for node in session.get_inputs()}
    outputs = {node.name: list(node.shape[1:]) for node in session.get_outputs()}
    num_layers = sum(name.startswith("keys_") for name in shapes)
    is_extended = f"{EXTENSION_PREFIX}state" in shapes
    more_inputs = [f"{EXTENSION_PREFIX}state"] * is_extended
    more_outputs = [f"{EXTENSION_PREFIX}{name}" for name in _OUTPUTS[:2]] * is_extended
    if list(shapes) != [*_INPUTS, *cache_names(num_layers), *more_inputs] or (
        list(outputs) != [*_OUTPUTS, *more_outputs]
    ):
        raise ValueError(f"its network has the inputs {', '.join(shapes)}")
    try:
        length, width = shapes["positions"]
        rings, heads, block, head_size = outputs["new"]
        sizes = BlockSizes(
            block=block,
            length=length,
            past=shapes["keys_0"][1],
            width=width,
            state=shapes[f"{EXTENSION_PREFIX if is_extended else ''}state"][0],
            layers=rings // 2,
            heads=heads,
            head_size=head_size,
        )
        are_positive = min(astuple(sizes)) >= 1
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"its network has the inputs {shapes}") from error
    if (
        not are_positive
        or max(length, width, sizes.state, num_layers) > _MAX_SIZE
        or width % 2
        or not block < length <= sizes.past
        or 2 * math.prod(sizes.rings) > _MAX_CACHE_BYTES
    ):
        raise ValueError(f"its network has the sizes {sizes}")
    return sizes, int(shapes["state"][0]) if is_extended else 0


def cache_names(num_layers: int) -> list[str]:
    """Return the names of a network's cache inputs, in the order of the rings."""
    return [f"{kind}_{layer}" for kind in ("keys", "values") for layer in range(num_layers)]


def parse_block_model(archive: Archive) -> BlockModel:
    """Build the model after checking every size; raises ``ValueError`` if a size is wrong."""
    return build_block_model(archive, archive.array("network", None).astype(np.uint8))


def build_block_model(archive: Archive, network: UInt8) -> BlockModel:
    """Build the model of a file with this network; raises like :func:`parse_block_model`."""
    topology = parse_topology(archive)
    model = BlockModel(
        topology=topology,
        network=network,
        log_prior=archive.floats("log_prior", topology.num_states),
        acoustic_scale=float(archive.floats("acoustic_scale")),
    )
    sizes = model.runner.sizes
    past = NetworkState(np.zeros(sizes.state, np.float32), np.zeros(sizes.rings, np.float16))
    frames = np.zeros((2 * sizes.length + 3, NUM_MELS), np.float32)
    # differs from the file's constant, to check that the input replaces it
    num_kept = sizes.block + 1
    outputs = model.runner.run([Block(frames, 0, sizes.length, num_kept, num_kept, past)])
    cache_shape = (1, 2 * sizes.layers, sizes.heads, num_kept, sizes.head_size)
    check_outputs(
        outputs, [(1, 2 * sizes.length, topology.num_states), (1, sizes.state), cache_shape]
    )
    return model
