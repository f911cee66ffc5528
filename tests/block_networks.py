"""A small block model with random weights."""

from functools import cache, partial

import numpy as np
import torch

from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.training.blocks.export import export_onnx
from kouxing.training.blocks.network import READOUT, BlockEncoder, BlockReadout
from kouxing.training.networks.network import EncoderShape
from tests.system import HELLO

FRAMES = np.resize(WhisperMel().accept_waveform(HELLO), (330, 80))  # more than a past
FRAMES[40, 7] = FRAMES[:40].max() - 3.0  # below the floor
SMALL = partial(EncoderShape, width=32, heads=2, layers=4, inner=48)
BLOCK, RIGHT = 5, 10
LENGTH = BLOCK + RIGHT
SCALE = np.float32(0.5)


@cache
def networks(num_states: int = 180) -> tuple[BlockEncoder, BlockReadout]:
    """Return the parts of a network that writes the scores of this many states."""
    torch.manual_seed(0)
    encoder = BlockEncoder(SMALL()).eval()
    with torch.no_grad():  # trained weights are larger than initial ones
        encoder.first.weight *= 6
        encoder.second.weight *= 6
        for name, weight in encoder.named_parameters():
            if name.endswith("query_key_value.weight"):
                weight.mul_(2)
    return encoder, BlockReadout(96, num_states, READOUT).eval()


@cache
def blocks() -> BlockModel:
    """Return a model with the phones of the shipped one."""
    shipped = load_model()
    assert isinstance(shipped, BlockModel)
    return BlockModel(
        topology=shipped.topology,
        network=export_onnx(*networks(shipped.topology.num_states), BLOCK),
        log_prior=shipped.log_prior,
        acoustic_scale=float(SCALE),
    )
