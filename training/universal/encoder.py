"""Computes features of recordings with the block network's encoder, in longer, faster blocks.

Its weights are the block model's 8-bit integers. Live, blocks have 2 positions and the same right
context; the network does not depend on the length of a block.
"""

from collections.abc import Sequence

import numpy as np
import onnx

from kouxing.services.recognizer.acoustic.blocks import BlockModel, cache_names
from kouxing.services.recognizer.acoustic.network import (
    FRAMES_PER_ENCODER_FRAME,
    open_onnx_session,
    position_table,
)
from kouxing.services.recognizer.front_end.whisper_mel import FLOOR_BANDS, NUM_MELS
from kouxing.shared.arrays import Float16, Floats, UInt8
from kouxing.training.blocks.export import BlockGraph
from kouxing.training.blocks.exported import rebuild_encoder
from kouxing.training.blocks.network import BlockEncoder
from kouxing.training.networks.network import PADDING_FRAMES
from kouxing.training.networks.onnx_graph import halves

BLOCK_LENGTH, RIGHT_CONTEXT, PAST = 10, 14, 120  # positions
LENGTH = BLOCK_LENGTH + RIGHT_CONTEXT
MAX_FRAMES = 2980  # limit for a recording: the table of positions ends after 30 s


class FeatureEncoder:
    """Computes hidden layers of recordings, in blocks with their right contexts."""

    def __init__(self, model: BlockModel, layers: Sequence[int]) -> None:
        encoder = rebuild_encoder(model)
        self._shape = encoder.shape
        self._session = open_onnx_session(_FeatureGraph(encoder, layers).file_of_features())
        unused = np.zeros((LENGTH, self._shape.width), np.float32)
        self._positions = np.concatenate([position_table(self._shape.width), unused])

    def encode(self, recordings: Sequence[Floats]) -> list[Float16]:
        """Encode log-mel frames, (n, 80) each, to (blocks, B + R, layers * width) each.

        The rows of positions that a block lacks are undefined.
        """
        shape, num_sessions = self._shape, len(recordings)
        num_positions = [-(-len(frames) // FRAMES_PER_ENCODER_FRAME) for frames in recordings]
        num_blocks = -(-max(num_positions) // BLOCK_LENGTH)
        padded = [_padded(frames, num_blocks) for frames in recordings]
        size = shape.width // shape.heads
        rings = np.zeros((2 * shape.layers, num_sessions, shape.heads, PAST, size), np.float16)
        blocks = []
        for start in range(0, num_blocks * BLOCK_LENGTH, BLOCK_LENGTH):
            first = FRAMES_PER_ENCODER_FRAME * start
            window = slice(first, first + FRAMES_PER_ENCODER_FRAME * LENGTH + 3)
            positions = self._positions[start : start + LENGTH]
            features, new = self._session.run(
                ["features", "new"],
                {
                    "frames": np.stack([frames[window] for frames in padded]),
                    "positions": np.repeat(positions[None], num_sessions, axis=0),
                    "num_positions": np.clip(np.array(num_positions) - start, 1, LENGTH),
                    "num_cached": np.full(num_sessions, min(start, PAST)),
                    **dict(zip(cache_names(shape.layers), rings, strict=True)),
                },
            )
            blocks.append(features)
            slot = start % PAST
            rings[:, :, :, slot : slot + BLOCK_LENGTH] = new.swapaxes(0, 1)
        rows_by_session = np.stack(blocks, axis=1)
        return [
            rows[: -(-number // BLOCK_LENGTH)]
            for rows, number in zip(rows_by_session, num_positions, strict=True)
        ]


def _padded(frames: Floats, num_blocks: int) -> Floats:
    """Floor the bands as the recognizer does, and repeat the last frame."""
    num_frames = (
        PADDING_FRAMES + FRAMES_PER_ENCODER_FRAME * (num_blocks * BLOCK_LENGTH + LENGTH) + 3
    )
    padded = np.zeros((num_frames, NUM_MELS), np.float32)
    loudest = np.maximum.accumulate(frames.max(axis=1))
    end = PADDING_FRAMES + len(frames)
    padded[PADDING_FRAMES:end] = np.maximum(frames, (loudest - np.float32(FLOOR_BANDS))[:, None])
    padded[end : end + 2] = padded[end - 1]
    return padded


class _FeatureGraph(BlockGraph):
    """A block graph whose outputs are hidden layers."""

    def __init__(self, encoder: BlockEncoder, layers: Sequence[int]) -> None:
        super().__init__(encoder, None, BLOCK_LENGTH, RIGHT_CONTEXT, PAST)
        self._layers = layers
        self._width = encoder.shape.width * len(layers)

    def file_of_features(self) -> UInt8:
        """Add all nodes; return the ONNX file."""
        rows = self.features(self._layers)
        shape = self.integers("by_block", -1, self.length, self._width)
        hidden = self.node("Reshape", [rows, shape])
        self.node("Cast", [hidden], "features", to=onnx.TensorProto.FLOAT16)
        self.new_caches()
        outputs = [halves("features", "sessions", self.length, self._width), self.new]
        return self.file("features", self.inputs(), outputs)
