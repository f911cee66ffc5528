"""Reads the networks of a block model back into PyTorch, with their 8-bit weights as floats."""

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.training.blocks.network import BlockEncoder, BlockReadout
from kouxing.training.networks.network import EncoderShape, ReadoutShape
from kouxing.training.networks.onnx_graph import read_tensors, read_weight

M = TypeVar("M", bound=nn.Module)
_Tensors = Mapping[str, NDArray[Any]]


def rebuild_encoder(model: BlockModel) -> BlockEncoder:
    """Rebuild the encoder."""
    tensors, sizes = read_tensors(model.network), model.runner.sizes
    shape = EncoderShape(
        width=sizes.width,
        heads=sizes.heads,
        layers=sizes.layers,
        inner=len(tensors["layers.0.inner.bias"]),
    )
    return _load(BlockEncoder(shape), tensors)


def rebuild_readout(model: BlockModel) -> BlockReadout:
    """Rebuild the readout, whose recurrent layer is exported in ONNX's layout."""
    tensors = read_tensors(model.network)
    inner = len(tensors["readout.inner.bias"])
    shape = ReadoutShape(inner=inner, gru=model.runner.sizes.state, dropout=0.0, noise=0.0)
    readout = BlockReadout(len(tensors["readout.mean"]), model.topology.num_states, shape)
    input_biases, recurrent_biases = np.split(tensors["readout.biases"], 2, axis=1)
    recurrent = {
        "weight_ih": tensors["readout.input_weights.halves"],
        "weight_hh": tensors["readout.recurrent_weights.halves"],
        "bias_ih": input_biases,
        "bias_hh": recurrent_biases,
    }
    others = {"readout.deviation": 1 / tensors["readout.inverse"]}
    for name, directions in recurrent.items():
        for direction, suffix in zip(directions, ("", "_reverse"), strict=True):
            update, reset, new = np.split(direction, 3)
            others[f"readout.gru.{name}_l0{suffix}"] = np.concatenate([reset, update, new])
    return _load(readout, {**tensors, **others}, "readout.")


def _load(module: M, tensors: _Tensors, prefix: str = "") -> M:
    """Load the weights of a module (:mod:`kouxing.training.networks.onnx_graph`)."""
    state = {}
    for name, tensor in module.state_dict().items():
        stem = f"{prefix}{name}".removesuffix(".weight")
        if f"{stem}.integers" in tensors and name.endswith(".weight"):
            weight = read_weight(tensors, stem)
            if tensor.ndim == 3:  # a convolution, place by place
                weight = weight.reshape(len(weight), tensor.shape[2], -1).transpose(0, 2, 1)
        else:
            weight = tensors[f"{prefix}{name}"]
        state[name] = torch.from_numpy(np.array(weight, np.float32))
    module.load_state_dict(state)
    return module.eval()
