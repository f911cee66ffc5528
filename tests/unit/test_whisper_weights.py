"""Whisper's weights, and the loss of soft targets."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.shared.errors import UserError
from kouxing.training.networks.network import EncoderShape
from kouxing.training.networks.teacher import WholeEncoder
from kouxing.training.networks.whisper import load_whisper
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

SMALL = partial(EncoderShape, width=32, heads=2, layers=2, inner=48)
SHAPE = SMALL()


# --- Whisper's weights


def floats(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().numpy()


def test_loads_whispers_weights(tmp_path: Path) -> None:
    arrays = encoder_arrays()
    other = {"decoder/projection/weight": np.zeros((4, 4), np.float16)}
    network = WholeEncoder(SHAPE)
    load_whisper(network, write_whisper(tmp_path, {**other, **arrays}))
    attention, forward = "layer_1/self_attention", "layer_1/ffn"
    pairs = {
        "first": "conv1",
        "second": "conv2",
        "layers.1.attention_norm": f"{attention}/layer_norm",
        "layers.1.query_key_value": f"{attention}/linear_0",
        "layers.1.attended": f"{attention}/linear_1",
        "layers.1.inner_norm": f"{forward}/layer_norm",
        "layers.1.inner": f"{forward}/linear_0",
        "layers.1.outer": f"{forward}/linear_1",
    }
    after = network.state_dict()
    for ours, theirs in pairs.items():
        kinds = ("gamma", "beta") if "norm" in theirs else ("weight", "bias")
        for kind, of_file in zip(("weight", "bias"), kinds, strict=True):
            expected = arrays[f"encoder/{theirs}/{of_file}"].astype(np.float32)
            np.testing.assert_array_equal(floats(after[f"{ours}.{kind}"]), expected)


def test_rejects_files_of_other_kinds_and_sizes(tmp_path: Path) -> None:
    def refused(message: str) -> None:
        with pytest.raises(UserError, match=message) as error:
            load_whisper(WholeEncoder(SHAPE), tmp_path)
        assert str(tmp_path / "model.bin") in str(error.value)

    write_whisper(tmp_path, encoder_arrays(width=64))
    refused("64 x 80 x 3 instead of 32 x 80 x 3; use the folder of a Whisper model of width 32")
    write_whisper(tmp_path, encoder_arrays(num_layers=1))
    refused("lacks encoder/layer_1")
    write_whisper(tmp_path, encoder_arrays(), version=3)
    refused("its version 3 is too old")
    quantized = {"encoder/conv1/weight": np.ones((32, NUM_MELS, 3), np.int8)}
    write_whisper(tmp_path, encoder_arrays() | quantized)
    refused("conv1/weight is quantized")
    (tmp_path / "model.bin").write_bytes(b"")
    refused("not a Whisper model")
