"""What the exports of Whisper's encoder and its readout to ONNX share.

Products with weights are of 8-bit integers. A weight ``W`` has a scale ``s`` for each output, its
input ``x`` a scale ``r`` for each row:

    y[i, j] = r[i] s[j] sum_k round(x[i, k] / r[i]) round(W[k, j] / s[j]) + b[j]
    r[i] = max_k |x[i, k]| / 127,   s[j] = max_k |W[k, j]| / 127

So a row's values do not depend on the other rows of a product. Large weights that are no integers
are stored as 16-bit floats, and widened when the file is opened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from training.blocks.readout import MAX_DEVIATIONS

DOMAIN = "com.microsoft"  # of onnxruntime's own operators
_OPERATORS = 20  # version of the ONNX operator set
_FORMAT = 9  # version of the ONNX file format
_MAX_INTEGER = 127
_ZERO_POINT = 128  # the integer for an input of 0
_MIN_SCALE = 1e-12
_EPSILON = 1e-5  # of the norms, as PyTorch's

Floats = NDArray[np.float32]


class Graph:
    """The nodes and constants of a network, in the order of computation."""

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._tensors: dict[str, onnx.TensorProto] = {}

    def file(
        self,
        name: str,
        inputs: Sequence[onnx.ValueInfoProto],
        outputs: Sequence[onnx.ValueInfoProto],
    ) -> NDArray[np.uint8]:
        """Return the bytes of an ONNX file."""
        tensors = list(self._tensors.values())
        graph = helper.make_graph(self._nodes, name, inputs, outputs, initializer=tensors)
        imports = [helper.make_opsetid("", _OPERATORS), helper.make_opsetid(DOMAIN, 1)]
        model = helper.make_model(graph, opset_imports=imports)
        model.ir_version = _FORMAT
        onnx.checker.check_model(model)
        return np.frombuffer(model.SerializeToString(), dtype=np.uint8)

    def node(self, kind: str, inputs: Sequence[str], output: str = "", **settings: Any) -> str:
        """Add a node with one output, and return the output's name."""
        output = output or f"{kind}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [output], **settings))
        return output

    def split(self, inputs: str, names: Sequence[str], *sizes: int) -> Sequence[str]:
        """Split the last axis into equal parts, or into parts of these sizes; return the names."""
        if sizes:
            lengths = self.integers(f"{names[0]}.lengths", *sizes)
            node = helper.make_node("Split", [inputs, lengths], names, axis=-1)
        else:
            node = helper.make_node("Split", [inputs], names, axis=-1, num_outputs=len(names))
        self._nodes.append(node)
        return names

    def constant(self, name: str, array: NDArray[Any] | np.generic | float) -> str:
        """Store a constant once, and return its name."""
        if name not in self._tensors:
            self._tensors[name] = numpy_helper.from_array(np.array(array, order="C"), name)
        return name

    def integers(self, name: str, *values: int) -> str:
        """Store integers, of a shape or axes."""
        return self.constant(name, np.array(values, np.int64))

    def number(self, name: str, value: float) -> str:
        """Store one number."""
        return self.constant(name, np.array(value, np.float32))

    def halves(self, name: str, array: Floats) -> str:
        """Store 16-bit floats; onnxruntime widens them once, when it opens the file."""
        stored = self.constant(f"{name}.halves", array.astype(np.float16))
        return self.node("Cast", [stored], to=TensorProto.FLOAT)

    def norm(self, inputs: str, parameters: Mapping[str, Floats], name: str) -> str:
        """Normalise rows."""
        names = [
            self.constant(f"{name}.{kind}", parameters[f"{name}.{kind}"])
            for kind in ("weight", "bias")
        ]
        return self.node("LayerNormalization", [inputs, *names], epsilon=_EPSILON)

    def product(self, inputs: str, parameters: Mapping[str, Floats], name: str) -> str:
        """Multiply rows, (rows, inputs), with a weight in 8 bits and add a bias."""
        last = self.integers("last_axis", -1)
        highest = self.node("ReduceMax", [self.node("Abs", [inputs]), last], keepdims=0)
        scale = self.node("Mul", [highest, self.number("step", 1 / _MAX_INTEGER)])
        scale = self.node("Max", [scale, self.number("min_scale", _MIN_SCALE)])
        if "zero_points" not in {node.output[0] for node in self._nodes}:  # one for each row
            value = numpy_helper.from_array(np.array([_ZERO_POINT], np.uint8))
            self.node("ConstantOfShape", [self.node("Shape", [scale])], "zero_points", value=value)
        rounded = self.node("QuantizeLinear", [inputs, scale, "zero_points"], axis=0)
        integers, scales = self.weight(parameters, name)
        one = self.number("one", 1.0)
        zero_point = self.constant("zero_point", np.array(_ZERO_POINT, np.uint8))
        summed = self.node(
            "MatMulIntegerToFloat", [rounded, integers, one, scales, zero_point], domain=DOMAIN
        )
        by_row = self.node("Mul", [summed, self.node("Unsqueeze", [scale, last])])
        return self.node("Add", [by_row, self.constant(f"{name}.bias", parameters[f"{name}.bias"])])

    def weight(self, parameters: Mapping[str, Floats], name: str) -> tuple[str, str]:
        """Store a weight: integers, (inputs, outputs), and the scales of its outputs."""
        weight = parameters[f"{name}.weight"]
        scale = np.maximum(np.abs(weight).max(axis=1) / _MAX_INTEGER, _MIN_SCALE)
        integers = np.rint(weight / scale[:, None]).astype(np.int8).T
        return (
            self.constant(f"{name}.integers", integers),
            self.constant(f"{name}.scales", scale.astype(np.float32)),
        )

    def convolutions(self, bands: str, parameters: Mapping[str, Floats], padding: int) -> str:
        """Run both: (batch, 80, frames) to (batch, positions, width)."""
        hidden = bands
        for name, stride in (("first", 1), ("second", 2)):
            names = [
                self.halves(f"{name}.{kind}", parameters[f"{name}.{kind}"])
                for kind in ("weight", "bias")
            ]
            convolved = self.node(
                "Conv", [hidden, *names], pads=[padding, padding], strides=[stride]
            )
            hidden = self.node("Gelu", [convolved])
        return self.node("Transpose", [hidden], perm=[0, 2, 1])

    def readout_inner(self, features: str, parameters: Mapping[str, Floats]) -> str:
        """Compute the recurrent layer's input: (rows, features) to (rows, inner)."""
        mean = self.constant("readout.mean", parameters["readout.mean"])
        inverse = self.constant("readout.inverse", 1 / parameters["readout.deviation"])
        limits = [self.number(f"limit_{sign}", sign * MAX_DEVIATIONS) for sign in (-1, 1)]
        standard = self.node("Mul", [self.node("Sub", [features, mean]), inverse])
        standard = self.node("Clip", [standard, *limits])
        return self.node("Gelu", [self.product(standard, parameters, "readout.inner")])

    def recurrent_weights(self, parameters: Mapping[str, Floats]) -> list[str]:
        """Store the recurrent layer's weights and biases."""

        def gates(kind: str) -> Floats:
            ends = ("", "_reverse")
            return np.stack([_gates(parameters[f"readout.gru.{kind}_l0{end}"]) for end in ends])

        biases = np.hstack([gates("bias_ih"), gates("bias_hh")])
        return [
            self.halves("readout.input_weights", gates("weight_ih")),
            self.halves("readout.recurrent_weights", gates("weight_hh")),
            self.constant("readout.biases", biases),
        ]

    def recurrent(self, inner: str, weights: Sequence[str], width: int, *states: str) -> str:
        """Run the recurrent layer: (n, batch, inner) to (n, directions, batch, width).

        ``states`` are the numbers of rows, (batch,), and first states, (directions, batch, width).
        """
        return self.node(
            "GRU",
            [inner, *weights, *states],
            hidden_size=width,
            direction="bidirectional",
            linear_before_reset=1,
        )

    def readout_output(
        self, context: str, inner: str, parameters: Mapping[str, Floats], *shape: int
    ) -> str:
        """Compute log posteriors of rows, in a shape whose last axis are the states."""
        both = self.node("Concat", [context, inner], axis=-1)
        logits = self.product(both, parameters, "readout.output")
        by_frame = self.integers("by_frame", *shape)
        return self.node("LogSoftmax", [self.node("Reshape", [logits, by_frame])], axis=-1)


def arrays_of(module: nn.Module, prefix: str = "") -> dict[str, Floats]:
    """Return a module's parameters and buffers; their names begin with ``prefix``."""
    return {prefix + name: tensor.cpu().numpy() for name, tensor in module.state_dict().items()}


def floats(name: str, *shape: int | str) -> onnx.ValueInfoProto:
    """Describe an input or output."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def _gates(stacked: Floats) -> Floats:
    """PyTorch's gates reset, update, new in ONNX's order: update, reset, new."""
    reset, update, new = np.split(stacked, 3)
    return np.concatenate([update, reset, new])
