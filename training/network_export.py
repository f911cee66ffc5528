"""Write a trained network as ONNX, the form in which the recognizer runs it.

The graph is what :class:`training.network.Network` computes, a chunk of frames at a time with the
recurrent layers' states coming in and going out, and the output layer chosen by its number.
Weights are kept as 16-bit floats, which halves the file; the sums are in 32 bits.
"""

from __future__ import annotations

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from training.network import FRONT_FRAMES, NUM_INPUTS, Network

_OPERATORS = 17  # version of the ONNX operator set
_FORMAT = 8  # version of the ONNX file format


def onnx_of(network: Network) -> NDArray[np.uint8]:
    """Return the bytes of an ONNX file.

    Its inputs are ``x`` (frames, batch, 205), the last five frames, oldest first; ``h1`` and ``h2``
    (1, batch, H), the states of the recurrent layers; and ``head``, the number of the output
    layer. Its outputs are log shares (frames, batch, states) and the new states.
    """
    shape = network.shape
    parameters = {
        name: tensor.numpy().astype(np.float16) for name, tensor in network.state_dict().items()
    }
    front = parameters["front.weight"].transpose(2, 1, 0)  # (5, 41, width)
    heads = range(len(shape.look_aheads))
    weights = {
        "front_weight": front.reshape(FRONT_FRAMES * NUM_INPUTS, shape.front),
        "front_bias": parameters["front.bias"],
        **_recurrent("first", parameters),
        **_recurrent("second", parameters),
        "head_weight": np.stack([parameters[f"heads.{head}.weight"].T for head in heads]),
        "head_bias": np.stack([parameters[f"heads.{head}.bias"] for head in heads]),
    }
    half = [numpy_helper.from_array(array, f"{name}_16") for name, array in weights.items()]
    axis = numpy_helper.from_array(np.array([1]), "axis")
    nodes = [
        *(helper.make_node("Cast", [f"{n}_16"], [n], to=TensorProto.FLOAT) for n in weights),
        helper.make_node("MatMul", ["x", "front_weight"], ["front_product"]),
        helper.make_node("Add", ["front_product", "front_bias"], ["front_sum"]),
        helper.make_node("Relu", ["front_sum"], ["front"]),
        *_layer("first", "front", "h1", shape.hidden),
        *_layer("second", "first", "h2", shape.hidden),
        helper.make_node("Concat", ["first", "second"], ["both"], axis=2),
        helper.make_node("Gather", ["head_weight", "head"], ["weight"], axis=0),
        helper.make_node("Gather", ["head_bias", "head"], ["bias"], axis=0),
        helper.make_node("MatMul", ["both", "weight"], ["product"]),
        helper.make_node("Add", ["product", "bias"], ["logits"]),
        helper.make_node("LogSoftmax", ["logits"], ["log_share"], axis=-1),
    ]
    state: list[int | str] = [1, "batch", shape.hidden]
    graph = helper.make_graph(
        nodes,
        "recurrent acoustic model",
        inputs=[
            _value("x", ["frames", "batch", FRONT_FRAMES * NUM_INPUTS]),
            _value("h1", state),
            _value("h2", state),
            helper.make_tensor_value_info("head", TensorProto.INT64, []),
        ],
        outputs=[
            _value("log_share", ["frames", "batch", shape.num_states]),
            _value("h1_after", state),
            _value("h2_after", state),
        ],
        initializer=[*half, axis],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPERATORS)])
    model.ir_version = _FORMAT
    onnx.checker.check_model(model)
    return np.frombuffer(model.SerializeToString(), dtype=np.uint8)


def _value(name: str, shape: list[int | str]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def _recurrent(
    name: str, parameters: dict[str, NDArray[np.float16]]
) -> dict[str, NDArray[np.float16]]:
    """Weights in ONNX's order of the gates: update, reset, new; PyTorch has reset first."""

    def swapped(kind: str) -> NDArray[np.float16]:
        reset, update, new = np.split(parameters[f"{name}.{kind}_l0"], 3)
        return np.concatenate([update, reset, new])[None]

    return {
        f"{name}_input": swapped("weight_ih"),
        f"{name}_state": swapped("weight_hh"),
        f"{name}_bias": np.concatenate([swapped("bias_ih"), swapped("bias_hh")], axis=1),
    }


def _layer(name: str, below: str, state: str, hidden: int) -> list[onnx.NodeProto]:
    inputs = [below, f"{name}_input", f"{name}_state", f"{name}_bias", "", state]
    outputs = [f"{name}_directions", f"{state}_after"]
    return [
        helper.make_node("GRU", inputs, outputs, hidden_size=hidden, linear_before_reset=1),
        helper.make_node("Squeeze", [outputs[0], "axis"], [name]),
    ]
