"""Shared parts of the ONNX exports.

Products with weights use 8-bit integers. A weight ``W`` has a scale ``s`` for each output, its
input ``x`` a scale ``r`` for each row:

    y[i, j] = r[i] s[j] sum_k round(x[i, k] / r[i]) round(W[k, j] / s[j]) + b[j]
    r[i] = max_k |x[i, k]| / 127,   s[j] = max_k |W[k, j]| / 127

The values of a row therefore do not depend on other rows. Convolutions are products too. Other
large weights are stored as 16-bit floats, and widened when the file is opened.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.shared.arrays import Floats, UInt8

DOMAIN = "com.microsoft"  # domain of onnxruntime's own operators
_OPERATORS = 20  # version of the ONNX operator set
_FORMAT = 9  # version of the ONNX file format
_MAX_INTEGER = 127
_ZERO_POINT = 128  # the integer for an input of 0
_MIN_SCALE = 1e-12
_EPSILON = 1e-5  # epsilon of the norms, as in PyTorch


class Graph:
    """Collects the nodes and constants of a network in the order of computation.

    ``prefix`` precedes the names of nodes and constants.
    """

    def __init__(self, prefix: str = "") -> None:
        self.prefix = prefix
        self._nodes: list[onnx.NodeProto] = []
        self._num_nodes = 0  # for their names
        self._tensors: dict[str, onnx.TensorProto] = {}
        self._zero_points: dict[str, str] = {}  # by the kind of rows

    def file(
        self,
        name: str,
        inputs: Sequence[onnx.ValueInfoProto],
        outputs: Sequence[onnx.ValueInfoProto],
    ) -> UInt8:
        """Return the bytes of an ONNX file."""
        graph = self._graph(name, inputs, outputs)
        imports = [helper.make_opsetid("", _OPERATORS), helper.make_opsetid(DOMAIN, 1)]
        model = helper.make_model(graph, opset_imports=imports)
        model.ir_version = _FORMAT
        onnx.checker.check_model(model)
        return np.frombuffer(model.SerializeToString(), dtype=np.uint8)

    def extension(
        self, inputs: Sequence[onnx.ValueInfoProto], outputs: Sequence[onnx.ValueInfoProto]
    ) -> UInt8:
        """Return bytes that add the nodes to the ONNX file to which they are appended."""
        model = onnx.ModelProto(graph=self._graph("", inputs, outputs))
        return np.frombuffer(model.SerializeToString(), dtype=np.uint8)

    def _graph(
        self,
        name: str,
        inputs: Sequence[onnx.ValueInfoProto],
        outputs: Sequence[onnx.ValueInfoProto],
    ) -> onnx.GraphProto:
        tensors = list(self._tensors.values())
        return helper.make_graph(self._nodes, name, inputs, outputs, initializer=tensors)

    def node(self, kind: str, inputs: Sequence[str], output: str = "", **settings: Any) -> str:
        """Add a node with one output, and return the output's name."""
        self._num_nodes += 1
        output = output or f"{self.prefix}{kind}_{self._num_nodes}"
        self._nodes.append(helper.make_node(kind, inputs, [output], **settings))
        return output

    def split(
        self, inputs: str, names: Sequence[str], *sizes: int, axis: int = -1
    ) -> Sequence[str]:
        """Split an axis into parts, of these sizes or equal; return their names."""
        if sizes:
            lengths = self.integers(f"{names[0]}.lengths", *sizes)
            node = helper.make_node("Split", [inputs, lengths], names, axis=axis)
        else:
            node = helper.make_node("Split", [inputs], names, axis=axis, num_outputs=len(names))
        self._nodes.append(node)
        return names

    def constant(self, name: str, array: NDArray[Any] | np.generic | float) -> str:
        """Store a constant once, and return its name."""
        name = self.prefix + name
        if name not in self._tensors:
            self._tensors[name] = numpy_helper.from_array(np.array(array, order="C"), name)
        return name

    def integers(self, name: str, *values: int) -> str:
        """Store integers, such as a shape or axes."""
        return self.constant(name, np.array(values, np.int64))

    def number(self, name: str, value: float) -> str:
        """Store one number."""
        return self.constant(name, np.array(value, np.float32))

    def halves(self, name: str, array: Floats) -> str:
        """Store 16-bit floats; onnxruntime widens them once, when it opens the file."""
        return self.floats_of(self.constant(f"{name}.halves", array.astype(np.float16)))

    def floats_of(self, halves: str) -> str:
        """Widen 16-bit floats."""
        return self.node("Cast", [halves], to=TensorProto.FLOAT)

    def norm(self, inputs: str, parameters: Mapping[str, Floats], name: str) -> str:
        """Normalize rows."""
        names = [
            self.constant(f"{name}.{kind}", parameters[f"{name}.{kind}"])
            for kind in ("weight", "bias")
        ]
        return self.node("LayerNormalization", [inputs, *names], epsilon=_EPSILON)

    def product(
        self, inputs: str, parameters: Mapping[str, Floats], name: str, rows: str = "positions"
    ) -> str:
        """Multiply rows, (rows, inputs), with an 8-bit weight, and add a bias.

        ``rows`` names the kind of rows; all products of one kind have the same number of rows.
        """
        last = self.integers("last_axis", -1)
        highest = self.node("ReduceMax", [self.node("Abs", [inputs]), last], keepdims=0)
        scale = self.node("Mul", [highest, self.number("step", 1 / _MAX_INTEGER)])
        scale = self.node("Max", [scale, self.number("min_scale", _MIN_SCALE)])
        if rows not in self._zero_points:  # one for each row
            value = numpy_helper.from_array(np.array([_ZERO_POINT], np.uint8))
            shape = self.node("Shape", [scale])
            self._zero_points[rows] = self.node("ConstantOfShape", [shape], value=value)
        rounded = self.node("QuantizeLinear", [inputs, scale, self._zero_points[rows]], axis=0)
        integers, scales = self.weight(parameters, name)
        one = self.number("one", 1.0)
        zero_point = self.constant("zero_point", np.array(_ZERO_POINT, np.uint8))
        summed = self.node(
            "MatMulIntegerToFloat", [rounded, integers, one, scales, zero_point], domain=DOMAIN
        )
        by_row = self.node("Mul", [summed, self.node("Unsqueeze", [scale, last])])
        return self.node("Add", [by_row, self.constant(f"{name}.bias", parameters[f"{name}.bias"])])

    def weight(self, parameters: Mapping[str, Floats], name: str) -> tuple[str, str]:
        """Store a weight as integers, (inputs, outputs), and scales of its outputs."""
        weight = _in_rows(parameters[f"{name}.weight"])
        scale = np.maximum(np.abs(weight).max(axis=1) / _MAX_INTEGER, _MIN_SCALE)
        integers = np.rint(weight / scale[:, None]).astype(np.int8).T
        return (
            self.constant(f"{name}.integers", integers),
            self.constant(f"{name}.scales", scale.astype(np.float32)),
        )

    def layer(
        self, hidden: str, parameters: Mapping[str, Floats], name: str, attend: Callable[[str], str]
    ) -> str:
        """Run a transformer layer; ``attend`` maps query, key and value to the attended values."""
        normed = self.norm(hidden, parameters, f"{name}.attention_norm")
        attended = attend(self.product(normed, parameters, f"{name}.query_key_value"))
        attended = self.product(attended, parameters, f"{name}.attended")
        hidden = self.node("Add", [hidden, attended])
        normed = self.norm(hidden, parameters, f"{name}.inner_norm")
        inner = self.node("Gelu", [self.product(normed, parameters, f"{name}.inner")])
        return self.node("Add", [hidden, self.product(inner, parameters, f"{name}.outer")])

    def convolutions(self, frames: str, parameters: Mapping[str, Floats], length: int) -> str:
        """Run both convolutions: (batch, 2 length + 3, 80) to (batch * length, width)."""
        windows = self._windows(frames, 2 * length + 1, 1, NUM_MELS)
        hidden = self.node("Gelu", [self.product(windows, parameters, "first", "frames")])
        width = len(parameters["first.bias"])
        by_frame = self.integers("by_frame_of_batch", -1, 2 * length + 1, width)
        windows = self._windows(self.node("Reshape", [hidden, by_frame]), length, 2, width)
        return self.node("Gelu", [self.product(windows, parameters, "second")])

    def _windows(self, inputs: str, number: int, stride: int, size: int) -> str:
        """Concatenate groups of three neighbors: (batch, n, size) to (batch * number, 3 size)."""
        one, step = self.integers("axis_1", 1), self.integers(f"stride_{stride}", stride)
        pieces = []
        for place in range(3):
            ends = [
                self.integers(f"from_{start}", start)
                for start in (place, place + stride * (number - 1) + 1)
            ]
            pieces.append(self.node("Slice", [inputs, *ends, one, step]))
        joined = self.node("Concat", pieces, axis=-1)
        return self.node("Reshape", [joined, self.integers(f"three_{size}", -1, 3 * size)])


def read_tensors(file: UInt8) -> dict[str, NDArray[Any]]:
    """Read the constants of an ONNX file, by name."""
    graph = onnx.load_from_string(file.tobytes()).graph
    return {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}


def read_weight(tensors: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    """Return the weight of a product, (outputs, inputs), from its integers and scales."""
    return np.asarray((tensors[f"{name}.integers"] * tensors[f"{name}.scales"]).T)


def module_arrays(module: nn.Module, prefix: str = "") -> dict[str, Floats]:
    """Return a module's parameters and buffers, with ``prefix`` before their names."""
    return {prefix + name: tensor.cpu().numpy() for name, tensor in module.state_dict().items()}


def _in_rows(weight: Floats) -> Floats:
    """Reshape a weight to (outputs, inputs), for a convolution place by place."""
    if weight.ndim == 3:
        weight = weight.transpose(0, 2, 1)
    return weight.reshape(len(weight), -1)


def floats(name: str, *shape: int | str) -> onnx.ValueInfoProto:
    """Describe an input or output."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def halves(name: str, *shape: int | str) -> onnx.ValueInfoProto:
    """Describe an input or output of 16-bit floats."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT16, shape)
