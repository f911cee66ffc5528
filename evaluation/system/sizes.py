"""Sizes of models and messages, and the physical floor of the recognizer's processor time.

The floor is the number of multiplications and additions of the networks in a second of speech,
divided by the rate of one core. This rate is four times the rate of a float32 matrix product,
because the weights have 8 bits. The block network processes its block and its right context in each
run, the audio encoder each encoder frame once.
"""

import time
from dataclasses import dataclass

import numpy as np
from kouxing_client.messages import encode

from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.encoder import ENCODER_PATH
from kouxing.services.recognizer.acoustic.load import MODELS_FOLDER, load_model
from kouxing.shared.face.faps import NUM_FAPS

_MATRIX_SIZE, _MEASURE_S = 512, 0.5
_ENCODER_FRAMES_PER_S = 50
_INT8_SPEED_UP = 4
_BLOCKS, _ENCODER = "block network", "audio encoder"
_OPERATIONS = 2  # per weight and encoder frame


@dataclass(frozen=True, slots=True)
class Sizes:
    """Figures of this machine and this version."""

    model_bytes: dict[str, int]
    frame_bytes: int  # size of a message with a face's FAPs
    gemm_gflops: float  # speed of one core, float32
    network_gflop_per_s: dict[str, float]  # per second of speech

    def floor_cores(self, hop: int = 1) -> float:
        """Return the cores that the networks would need at the highest rate of products.

        The block network runs once in ``hop`` blocks, up to ``MAX_HOP_BLOCKS`` under load.
        """
        gflop = self.network_gflop_per_s[_BLOCKS] / hop + self.network_gflop_per_s[_ENCODER]
        return gflop / (_INT8_SPEED_UP * self.gemm_gflops)


def measure() -> Sizes:
    """Measure sizes and the rate of the matrix product."""
    blocks = load_model("blocks")
    assert isinstance(blocks, BlockModel)  # noqa: S101 - the file of this name is one
    sizes = blocks.runner.sizes
    encoder_bytes = len(np.load(ENCODER_PATH, allow_pickle=False)["network"])
    weighted_positions = {  # weights are bytes; encoder frames per second of speech
        _BLOCKS: len(blocks.network) * sizes.length * _ENCODER_FRAMES_PER_S / sizes.block,
        _ENCODER: encoder_bytes * _ENCODER_FRAMES_PER_S,
    }
    fields = {"values": bytes(4 * NUM_FAPS), "mask": bytes(9), "media_time": 16_000_000, "epoch": 1}
    return Sizes(
        model_bytes={
            path.stem: path.stat().st_size for path in sorted(MODELS_FOLDER.glob("*.npz"))
        },
        frame_bytes=sum(map(len, encode("fap-frame", "session-1", fields))),
        gemm_gflops=_gemm_gflops(),
        network_gflop_per_s={
            name: _OPERATIONS * number / 1e9 for name, number in weighted_positions.items()
        },
    )


def _gemm_gflops() -> float:
    matrix = np.ones((_MATRIX_SIZE, _MATRIX_SIZE), np.float32)
    (matrix @ matrix).sum()  # warm up
    start_s, num = time.process_time(), 0
    while time.process_time() - start_s < _MEASURE_S:
        _ = matrix @ matrix
        num += 1
    return _OPERATIONS * num * _MATRIX_SIZE**3 / (time.process_time() - start_s) / 1e9
