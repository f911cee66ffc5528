"""Write a trained network as ONNX, which the recognizer runs; read it again.

The graph computes ``training.neural.network.Network`` at one position, for any number of sessions:
keys and values of earlier positions are inputs, those of this position are outputs.

============== ============================================================ ===================
symbol         meaning                                                      shape
============== ============================================================ ===================
frames         the five frames at a position, oldest first                  (rows, 400)
position       its row of the sinusoidal table                              (rows, width)
output_layer   number of the output layer                                   1
past_mask      0 in the slots of earlier positions and in the last slot;    (sessions, 1, 1,
               elsewhere minus infinity                                     128)
keys_l         keys of earlier positions in layer l, in any order; zeros    (sessions, heads,
               in the last slot, which is the position's own                size, 128)
values_l       their values                                                 (sessions, heads,
                                                                            128, size)
log_posteriors log posteriors of the states at two frames                   (rows, 2, states)
keys           keys of this position                                        (rows, layers,
                                                                            heads, size)
values         its values                                                   (rows, layers,
                                                                            heads, size)
============== ============================================================ ===================

There are as many rows as sessions, or two rows of a single session: then both are the same.

Weights have 8 bits, with a scale for each output. onnxruntime's operator MatMulNBits multiplies
with them directly, after rounding the inputs to 8 bits with a scale for every 32 numbers. A network
that runs one position at a time is limited by reading its weights, since each of them takes part in
a few products only. Norms and biases are floats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from services.recognizer.acoustic.network import NUM_INPUTS, SEEN_FRAMES, WINDOW
from training.neural.network import Network, Shape

_OPERATORS = 20  # version of the ONNX operator set
_FORMAT = 9  # version of the ONNX file format
_DOMAIN = "com.microsoft"  # of onnxruntime's own operators
_BITS = 8
_ZERO_POINT = 128  # the integer for a weight of 0
_MAX_INTEGER = 127
_MIN_SCALE = 1e-12
_BLOCK = 32  # inputs that are rounded together
_INTEGER_PRODUCTS = 4  # the operator's accuracy level that multiplies integers
_EPSILON = 1e-5  # of the norms, as PyTorch's

Floats = NDArray[np.float32]


def onnx_of(network: Network, *, exact: bool = False) -> NDArray[np.uint8]:
    """Export a network: return the bytes of an ONNX file, its inputs and outputs as above.

    Parameters
    ----------
    network
        A network.
    exact
        Keep the weights as floats: the file is four times as large, and slower.
    """
    parameters = {name: tensor.cpu().numpy() for name, tensor in network.state_dict().items()}
    graph = _Graph(network.shape, parameters, exact=exact)
    graph.write()
    model = helper.make_model(
        graph.proto(),
        opset_imports=[helper.make_opsetid("", _OPERATORS), helper.make_opsetid(_DOMAIN, 1)],
    )
    model.ir_version = _FORMAT
    onnx.checker.check_model(model)
    return np.frombuffer(model.SerializeToString(), dtype=np.uint8)


def network_of(file: NDArray[np.uint8], look_aheads: Sequence[int]) -> Network:
    """Read the network in an ONNX file of :func:`onnx_of`, to train it further.

    Parameters
    ----------
    file
        Bytes of the file.
    look_aheads
        Look-aheads of the output layers, feature frames.

    Raises
    ------
    KeyError
        If :func:`onnx_of` has not made the file.
    """
    stored = {
        constant.name: numpy_helper.to_array(constant)
        for constant in onnx.load_model_from_string(file.tobytes()).graph.initializer
    }
    biases = {name: array for name, array in stored.items() if name.endswith(".bias")}
    shape = Shape(
        num_states=len(biases["outputs.0.bias"]) // 2,
        look_aheads=tuple(look_aheads),
        width=len(biases["second.bias"]),
        heads=int(stored["by_head"][1]) // 3,
        layers=sum(name.endswith(".outer.bias") for name in biases),
        inner=len(biases["layers.0.inner.bias"]),
    )
    network = Network(shape)
    scale = 1 / _query_scale(shape)
    parameters = {}
    for name, tensor in network.state_dict().items():
        num_inputs = tensor.numel() // len(tensor)
        array = biases[name] if name in biases else _read_weight(stored, name, num_inputs)
        if ".query_key_value." in name:
            array = _scaled_query(array, scale)
        if tensor.dim() == 3:  # a convolution; the file keeps the numbers of a frame together
            array = array.reshape(len(array), 3, -1).transpose(0, 2, 1)
        parameters[name] = torch.from_numpy(array.copy())
    network.load_state_dict(parameters)
    return network


def _query_scale(shape: Shape) -> float:
    """Scale of the products of queries and keys; the file has it within the weights."""
    return float((shape.width // shape.heads) ** -0.5)


def _scaled_query(array: Floats, scale: float) -> Floats:
    """Scale the queries, a third of weights or biases, (3 width, ...)."""
    query, rest = np.split(array, [len(array) // 3])
    return np.concatenate([query * np.float32(scale), rest])


def _read_weight(stored: Mapping[str, NDArray[Any]], name: str, num_inputs: int) -> Floats:
    if name in stored:
        return np.asarray(stored[name], dtype=np.float32)
    if f"{name}.turned" in stored:
        return np.asarray(stored[f"{name}.turned"].T, dtype=np.float32)
    integers, scales = stored[f"{name}.integers"], stored[f"{name}.scales"]
    blocks = (integers.astype(np.float32) - _ZERO_POINT) * scales[..., None]
    return np.asarray(blocks.reshape(len(blocks), -1)[:, :num_inputs])


class _Graph:
    """The nodes and constants of a network, in the order of computation."""

    def __init__(self, shape: Shape, parameters: Mapping[str, Floats], *, exact: bool) -> None:
        self._shape = shape
        self._parameters = parameters
        self._exact = exact
        self._nodes: list[onnx.NodeProto] = []
        self._num_nodes = 0
        self._tensors: list[onnx.TensorProto] = []

    def write(self) -> None:
        """Write the whole network."""
        shape = self._shape
        size = shape.width // shape.heads
        self._constant("by_head", np.array([-1, 3 * shape.heads, 1, size]))
        self._constant("in_a_row", np.array([-1, shape.width]))
        self._constant("of_layer", np.array([-1, 1, shape.heads, size]))
        self._constant("by_frame", np.array([-1, 2, shape.num_states]))
        self._constant("thirds", np.full(3, shape.heads))
        self._constant("own_place", (np.arange(WINDOW) == WINDOW - 1).astype(np.float32))
        self._constant("before_last", np.array([WINDOW - 1]))
        self._constant("after_last", np.array([WINDOW]))
        self._constant("last_axis", np.array([-1]))
        hidden = self._front()
        for number in range(shape.layers):
            hidden = self._layer(f"layers.{number}", hidden, number)
        hidden = self._norm("norm", hidden)
        self._node("Identity", [self._outputs(hidden, 0)], "log_posteriors")
        for kind in ("keys", "values"):
            news = [f"{kind}_{number}_own" for number in range(shape.layers)]
            self._node("Concat", news, kind, axis=1)

    def proto(self) -> onnx.GraphProto:
        """Return the graph."""
        shape = self._shape
        size = shape.width // shape.heads
        sizes: dict[str, list[int | str]] = {"keys": [size, WINDOW], "values": [WINDOW, size]}
        caches = [
            _value(f"{kind}_{number}", ["sessions", shape.heads, *sizes[kind]])
            for kind in sizes
            for number in range(shape.layers)
        ]
        log_posteriors = _value("log_posteriors", ["rows", 2, shape.num_states])
        own: list[int | str] = ["rows", shape.layers, shape.heads, size]
        return helper.make_graph(
            self._nodes,
            "transformer acoustic model",
            inputs=[
                _value("frames", ["rows", SEEN_FRAMES * NUM_INPUTS]),
                _value("position", ["rows", shape.width]),
                helper.make_tensor_value_info("output_layer", TensorProto.INT64, []),
                _value("past_mask", ["sessions", 1, 1, WINDOW]),
                *caches,
            ],
            outputs=[log_posteriors, _value("keys", own), _value("values", own)],
            initializer=self._tensors,
        )

    def _front(self) -> str:
        """Both convolutions: the first at three places, which the second joins."""
        self._constant("frame_axis", np.array([1]))
        pieces = []
        for place in range(3):
            start, end = f"start_{place}", f"end_{place}"
            self._constant(start, np.array([place * NUM_INPUTS]))
            self._constant(end, np.array([(place + 3) * NUM_INPUTS]))
            pieces.append(self._node("Slice", ["frames", start, end, "frame_axis"]))
        self._constant("at_places", np.array([-1, 3 * NUM_INPUTS]))
        self._constant("of_places", np.array([-1, 3 * self._shape.width]))
        seen = self._node("Concat", pieces, axis=1)
        seen = self._node("Reshape", [seen, "at_places"])
        first = self._node("Gelu", [self._product("first", seen)])
        first = self._node("Reshape", [first, "of_places"])
        second = self._node("Gelu", [self._product("second", first)])
        return self._node("Add", [second, "position"])

    def _layer(self, name: str, hidden: str, number: int) -> str:
        joint = self._product(
            f"{name}.query_key_value", self._norm(f"{name}.attention_norm", hidden)
        )
        joint = self._node("Reshape", [joint, "by_head"])
        query, key, value = (f"{name}.{kind}" for kind in ("query", "key", "value"))
        self._nodes.append(
            helper.make_node("Split", [joint, "thirds"], [query, key, value], axis=1)
        )
        seen = self._node("Reshape", [self._attention(query, key, value, number), "in_a_row"])
        hidden = self._node("Add", [hidden, self._product(f"{name}.attended", seen)])
        for kind, own in (("keys", key), ("values", value)):
            self._node("Reshape", [own, "of_layer"], f"{kind}_{number}_own")
        inner = self._product(f"{name}.inner", self._norm(f"{name}.inner_norm", hidden))
        outer = self._product(f"{name}.outer", self._node("Gelu", [inner]))
        return self._node("Add", [hidden, outer])

    def _attention(self, query: str, key: str, value: str, number: int) -> str:
        """Attend to the past and to the position itself, (rows, heads, 1, size)."""
        past = self._node("MatMul", [query, f"keys_{number}"])
        past = self._node("Add", [past, "past_mask"])
        own = self._node("ReduceSum", [self._node("Mul", [query, key]), "last_axis"], keepdims=1)
        own = self._node("Mul", [own, "own_place"])
        weights = self._node("Softmax", [self._node("Add", [past, own])], axis=-1)
        seen = self._node("MatMul", [weights, f"values_{number}"])
        own = self._node("Slice", [weights, "before_last", "after_last", "last_axis"])
        return self._node("Add", [seen, self._node("Mul", [own, value])])

    def _outputs(self, hidden: str, number: int) -> str:
        """Compute the requested output layer, if its number is at least ``number``."""
        shape = self._shape
        if number == len(shape.look_aheads):
            nothing = numpy_helper.from_array(np.zeros((0, 2, shape.num_states), np.float32))
            return self._node("Constant", [], value=nothing)
        self._constant(f"number_{number}", np.array(number))
        asked = self._node("Equal", ["output_layer", f"number_{number}"])

        def this() -> str:
            logits = self._node("Reshape", [self._product(f"outputs.{number}", hidden), "by_frame"])
            return self._node("LogSoftmax", [logits], axis=-1)

        branches = {
            "then_branch": self._branch(f"output_{number}", this),
            "else_branch": self._branch(f"not_{number}", lambda: self._outputs(hidden, number + 1)),
        }
        return self._node("If", [asked], **branches)

    def _branch(self, name: str, write: Callable[[], str]) -> onnx.GraphProto:
        """Write nodes as a graph of their own; its constants stay in the outer graph."""
        outside, self._nodes = self._nodes, []
        output = write()
        result = _value(output, ["some_rows", 2, self._shape.num_states])
        graph = helper.make_graph(self._nodes, name, [], [result])
        self._nodes = outside
        return graph

    def _norm(self, name: str, hidden: str) -> str:
        for kind in ("weight", "bias"):
            self._constant(f"{name}.{kind}", self._parameters[f"{name}.{kind}"])
        inputs = [hidden, f"{name}.weight", f"{name}.bias"]
        return self._node("LayerNormalization", inputs, epsilon=_EPSILON)

    def _product(self, name: str, inputs: str) -> str:
        """Multiply rows with a weight and add a bias."""
        weight, bias = (self._parameters[f"{name}.{kind}"] for kind in ("weight", "bias"))
        if weight.ndim == 3:  # a convolution: keep the numbers of a frame together
            weight = weight.transpose(0, 2, 1).reshape(len(weight), -1)
        if name.endswith(".query_key_value"):
            scale = _query_scale(self._shape)
            weight, bias = _scaled_query(weight, scale), _scaled_query(bias, scale)
        self._constant(f"{name}.bias", bias)
        name, added = f"{name}.weight", f"{name}.bias"
        if self._exact:
            self._constant(f"{name}.turned", weight.T)
            return self._node("Add", [self._node("MatMul", [inputs, f"{name}.turned"]), added])
        integers, scales = _quantised(weight)
        self._constant(f"{name}.integers", integers)
        self._constant(f"{name}.scales", scales)
        return self._node(
            "MatMulNBits",
            [inputs, f"{name}.integers", f"{name}.scales", "", "", added],
            domain=_DOMAIN,
            K=weight.shape[1],
            N=len(weight),
            bits=_BITS,
            block_size=_BLOCK,
            accuracy_level=_INTEGER_PRODUCTS,
        )

    def _constant(self, name: str, array: NDArray[Any]) -> None:
        self._tensors.append(numpy_helper.from_array(array.copy(order="C"), name))

    def _node(self, kind: str, inputs: Sequence[str], output: str = "", **settings: Any) -> str:
        self._num_nodes += 1
        output = output or f"{kind}_{self._num_nodes}"
        self._nodes.append(helper.make_node(kind, inputs, [output], **settings))
        return output


def _quantised(weight: Floats) -> tuple[NDArray[np.uint8], Floats]:
    """Quantise a weight, (outputs, inputs): integers (outputs, blocks, 32) and their scales.

    All blocks of an output have the same scale.
    """
    num_blocks = -(-weight.shape[1] // _BLOCK)
    scale = np.maximum(np.abs(weight).max(axis=1) / _MAX_INTEGER, _MIN_SCALE)
    padded = np.zeros((len(weight), num_blocks * _BLOCK), np.float32)
    padded[:, : weight.shape[1]] = weight / scale[:, None]
    integers = (
        (np.rint(padded) + _ZERO_POINT).astype(np.uint8).reshape(len(weight), num_blocks, _BLOCK)
    )
    return integers, np.repeat(scale[:, None], num_blocks, axis=1).astype(np.float32)


def _value(name: str, shape: Sequence[int | str]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
