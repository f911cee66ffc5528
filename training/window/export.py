"""Write Whisper's encoder and a readout of it as ONNX, which the recognizer runs on windows.

The graph computes ``training.neural.teacher.WholeEncoder`` and
:class:`training.window.readout.Readout` on the last seconds of a segment.

================ ==================================================== =====================
symbol           meaning                                              shape
================ ==================================================== =====================
frames           log-mel frames of the window, oldest first           (frames, 80)
log_posteriors   log posteriors of the states of two frames           (2 positions, states)
features         positions after the kept layers, without a readout   (positions, features)
================ ==================================================== =====================

Position ``p`` has the frames ``2 p`` and ``2 p + 1``, the second of which may be one too many.

Products with weights are of 8-bit integers. A weight has a scale for each output. Its input is
rounded with one scale for the whole window (onnxruntime's DynamicQuantizeMatMul), so a window is
computed alone: in a batch its values would depend on the company. Convolutions, norms, attention
and the recurrent layer are floats.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from services.recognizer.acoustic.network import position_table
from services.recognizer.acoustic.window import FLOOR_BANDS
from services.recognizer.front_end.whisper_mel import NUM_MELS
from training.neural.teacher import WholeEncoder
from training.window.readout import MAX_DEVIATIONS, Readout

_OPERATORS = 20  # version of the ONNX operator set
_FORMAT = 9  # version of the ONNX file format
_DOMAIN = "com.microsoft"  # of onnxruntime's own operators
_MAX_INTEGER = 127
_MIN_SCALE = 1e-12
_EPSILON = 1e-5  # of the norms, as PyTorch's

Floats = NDArray[np.float32]


def onnx_of(
    encoder: WholeEncoder, readout: Readout | None, max_positions: int
) -> NDArray[np.uint8]:
    """Export an encoder: return the bytes of an ONNX file, its inputs and outputs as above.

    Parameters
    ----------
    encoder
        Whisper's encoder.
    readout
        What reads it; without one the output is ``features``.
    max_positions
        Positions in the longest window.
    """
    graph = _Graph(encoder, max_positions)
    inputs = [helper.make_tensor_value_info("frames", TensorProto.FLOAT, ["frames", NUM_MELS])]
    if readout is None:
        graph.node("Identity", [graph.features()], "features")
        size = len(encoder.kept_layers) * encoder.shape.width
        output = _floats("features", ["positions", size])
    else:
        graph.node("Identity", [graph.posteriors(graph.features(), readout)], "log_posteriors")
        output = _floats("log_posteriors", ["frames_or_one_more", encoder.shape.num_states])
    model = helper.make_model(
        helper.make_graph(graph.nodes, "window", inputs, [output], initializer=graph.tensors),
        opset_imports=[helper.make_opsetid("", _OPERATORS), helper.make_opsetid(_DOMAIN, 1)],
    )
    model.ir_version = _FORMAT
    onnx.checker.check_model(model)
    return np.frombuffer(model.SerializeToString(), dtype=np.uint8)


class _Graph:
    """The nodes and constants of a network, in the order of computation."""

    def __init__(self, encoder: WholeEncoder, max_positions: int) -> None:
        self._encoder = encoder
        self._parameters = _arrays(encoder)
        self._max_positions = max_positions
        self.nodes: list[onnx.NodeProto] = []
        self.tensors: list[onnx.TensorProto] = []

    def features(self) -> str:
        """Run the encoder; its kept layers, (positions, features)."""
        shape = self._encoder.shape
        after = []
        hidden = self._front()
        for number in range(shape.layers):
            hidden = self._layer(f"layers.{number}", hidden)
            after.append(hidden)
        kept = [after[place] for place in self._encoder.kept_layers]
        joined = self.node("Concat", kept, axis=-1)
        return self.node("Squeeze", [joined, self._integers("batch_axis", 0)])

    def posteriors(self, features: str, readout: Readout) -> str:
        """Run the readout on (positions, features): log posteriors, (2 positions, states)."""
        parameters = _arrays(readout)
        mean = self._constant("readout.mean", parameters["mean"])
        inverse = self._constant("readout.inverse", 1 / parameters["deviation"])
        limits = [
            self._constant(f"limit_{sign}", np.float32(sign * MAX_DEVIATIONS)) for sign in (-1, 1)
        ]
        standard = self.node("Mul", [self.node("Sub", [features, mean]), inverse])
        standard = self.node("Clip", [standard, *limits])
        inner = self.node("Gelu", [self._product("readout.inner", standard, parameters, "inner")])
        context = self._recurrent(inner, parameters)
        both = self.node("Concat", [context, inner], axis=-1)
        logits = self._product("readout.output", both, parameters, "output")
        by_frame = self._integers("by_frame", -1, self._encoder.shape.num_states)
        return self.node("LogSoftmax", [self.node("Reshape", [logits, by_frame])], axis=-1)

    def _front(self) -> str:
        """Limit the bands, run both convolutions and add the positions."""
        loudest = self.node("ReduceMax", ["frames"], keepdims=0)
        floor = self.node("Sub", [loudest, self._constant("floor", np.float32(FLOOR_BANDS))])
        bands = self.node("Transpose", [self.node("Max", ["frames", floor])], perm=[1, 0])
        hidden = self.node("Unsqueeze", [bands, self._integers("batch_axis", 0)])
        for name, stride in (("first", 1), ("second", 2)):
            names = [
                self._halves(f"{name}.{kind}", self._parameters[f"{name}.{kind}"])
                for kind in ("weight", "bias")
            ]
            convolved = self.node("Conv", [hidden, *names], pads=[1, 1], strides=[stride])
            hidden = self.node("Gelu", [convolved])
        hidden = self.node("Transpose", [hidden], perm=[0, 2, 1])
        table = position_table(self._encoder.shape.width)[: self._max_positions]
        rows = self.node("Shape", [hidden], start=1, end=2)
        zero = self._integers("zero", 0)
        used = self.node("Slice", [self._constant("positions", table), zero, rows, zero])
        return self.node("Add", [hidden, used])

    def _layer(self, name: str, hidden: str) -> str:
        normed = self._norm(f"{name}.attention_norm", hidden)
        joint = self._encoder_product(f"{name}.query_key_value", normed)
        query, key, value = (f"{name}.{kind}" for kind in ("query", "key", "value"))
        self.nodes.append(
            helper.make_node("Split", [joint], [query, key, value], axis=-1, num_outputs=3)
        )
        heads = self._encoder.shape.heads
        seen = self.node("MultiHeadAttention", [query, key, value], domain=_DOMAIN, num_heads=heads)
        hidden = self.node("Add", [hidden, self._encoder_product(f"{name}.attended", seen)])
        normed = self._norm(f"{name}.inner_norm", hidden)
        inner = self.node("Gelu", [self._encoder_product(f"{name}.inner", normed)])
        return self.node("Add", [hidden, self._encoder_product(f"{name}.outer", inner)])

    def _norm(self, name: str, hidden: str) -> str:
        names = [
            self._constant(f"{name}.{kind}", self._parameters[f"{name}.{kind}"])
            for kind in ("weight", "bias")
        ]
        return self.node("LayerNormalization", [hidden, *names], epsilon=_EPSILON)

    def _recurrent(self, inner: str, parameters: Mapping[str, Floats]) -> str:
        """Run the recurrent layer in both directions: (positions, 2 width)."""
        width = parameters["gru.weight_hh_l0"].shape[1]

        def gates(kind: str) -> Floats:
            return np.stack([_gates(parameters[f"gru.{kind}_l0{end}"]) for end in ("", "_reverse")])

        names = [
            self._halves("readout.input_weights", gates("weight_ih")),
            self._halves("readout.recurrent_weights", gates("weight_hh")),
            self._constant("readout.biases", np.hstack([gates("bias_ih"), gates("bias_hh")])),
        ]
        output = self.node(
            "GRU",
            [self.node("Unsqueeze", [inner, self._integers("batch_place", 1)]), *names],
            hidden_size=width,
            direction="bidirectional",
            linear_before_reset=1,
        )  # (positions, directions, batch, width)
        return self.node("Reshape", [output, self._integers("joined", -1, 2 * width)])

    def _encoder_product(self, name: str, inputs: str) -> str:
        return self._product(name, inputs, self._parameters, name)

    def _product(self, label: str, inputs: str, parameters: Mapping[str, Floats], name: str) -> str:
        """Multiply rows with a weight in 8 bits and add a bias."""
        weight = parameters[f"{name}.weight"]
        scale = np.maximum(np.abs(weight).max(axis=1) / _MAX_INTEGER, _MIN_SCALE)
        integers = np.rint(weight / scale[:, None]).astype(np.int8).T
        names = [
            self._constant(f"{label}.integers", integers),
            self._constant(f"{label}.scales", scale.astype(np.float32)),
            "",
            self._constant(f"{label}.bias", parameters[f"{name}.bias"]),
        ]
        return self.node("DynamicQuantizeMatMul", [inputs, *names], domain=_DOMAIN)

    def _halves(self, name: str, array: Floats) -> str:
        """Store a constant as 16-bit floats; onnxruntime widens it once, when it loads the file."""
        stored = self._constant(f"{name}.halves", array.astype(np.float16))
        return self.node("Cast", [stored], to=TensorProto.FLOAT)

    def _integers(self, name: str, *values: int) -> str:
        return self._constant(name, np.array(values, np.int64))

    def _constant(self, name: str, array: NDArray[Any] | np.generic) -> str:
        if all(tensor.name != name for tensor in self.tensors):
            self.tensors.append(numpy_helper.from_array(np.array(array, order="C"), name))
        return name

    def node(self, kind: str, inputs: Sequence[str], output: str = "", **settings: Any) -> str:
        """Add a node with one output, and return the output's name."""
        output = output or f"{kind}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **settings))
        return output


def _arrays(module: nn.Module) -> dict[str, Floats]:
    return {name: tensor.cpu().numpy() for name, tensor in module.state_dict().items()}


def _gates(stacked: Floats) -> Floats:
    """PyTorch's gates reset, update, new in ONNX's order: update, reset, new."""
    reset, update, new = np.split(stacked, 3)
    return np.concatenate([update, reset, new])


def _floats(name: str, shape: Sequence[int | str]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
