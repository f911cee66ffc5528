"""Export a trained network to ONNX for the recognizer.

The graph computes ``training.neural.network.Network`` at one position for any number of sessions.
Keys and values of earlier positions are inputs, those of this position are outputs.

============== ============================================================ ===================
symbol         meaning                                                      shape
============== ============================================================ ===================
frames         the five frames at a position, oldest first                  (rows, 400)
position       its row of the sinusoidal table                              (rows, width)
output_layer   number of the output layer                                   1
past_mask      0 in the slots of earlier positions and in the last slot;    (sessions, 1, 1,
               minus infinity elsewhere                                     128)
keys_l,        keys and values of earlier positions in layer l, in any      (sessions, heads,
values_l       order, 16-bit floats; zeros in the last slot, which          128, size)
               belongs to the position itself
log_posteriors log posteriors of the states at two frames                   (rows, 2, states)
keys, values   keys and values of this position                             (rows, layers,
                                                                            heads, size)
============== ============================================================ ===================

There is one row for each session. A single session has two identical rows.

Products use 8-bit integers (:mod:`kouxing.training.neural.onnx_graph`), norms and attention floats.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from kouxing.services.recognizer.acoustic.network import NUM_INPUTS, SEEN_FRAMES, WINDOW
from kouxing.training.neural.network import Network
from kouxing.training.neural.onnx_graph import DOMAIN, Graph, arrays_of, floats, halves


def onnx_of(network: Network) -> NDArray[np.uint8]:
    """Export a network as the bytes of an ONNX file with the inputs and outputs above."""
    return _NetworkGraph(network).file_of_network()


class _NetworkGraph(Graph):
    def __init__(self, network: Network) -> None:
        super().__init__()
        self._shape = network.shape
        self._parameters = arrays_of(network)

    def file_of_network(self) -> NDArray[np.uint8]:
        """Add all nodes; return the ONNX file."""
        shape = self._shape
        size = shape.width // shape.heads
        frames = self.node(
            "Reshape", ["frames", self.integers("seen", -1, SEEN_FRAMES, NUM_INPUTS)]
        )
        hidden = self.node("Add", [self.convolutions(frames, self._parameters, 1), "position"])
        for number in range(shape.layers):
            hidden = self._layer(f"layers.{number}", hidden, number)
        hidden = self.norm(hidden, self._parameters, "norm")
        self.node("Identity", [self._outputs(hidden, 0)], "log_posteriors")
        caches = []
        for kind in ("keys", "values"):
            names = [f"{kind}_{number}" for number in range(shape.layers)]
            self.node("Concat", [f"{name}_current" for name in names], kind, axis=1)
            caches += [halves(name, "sessions", shape.heads, WINDOW, size) for name in names]
        inputs = [
            floats("frames", "rows", SEEN_FRAMES * NUM_INPUTS),
            floats("position", "rows", shape.width),
            helper.make_tensor_value_info("output_layer", TensorProto.INT64, []),
            floats("past_mask", "sessions", 1, 1, WINDOW),
            *caches,
        ]
        of_position = ("rows", shape.layers, shape.heads, size)
        log_posteriors = floats("log_posteriors", "rows", 2, shape.num_states)
        outputs = [log_posteriors, floats("keys", *of_position), floats("values", *of_position)]
        return self.file("transformer acoustic model", inputs, outputs)

    def _layer(self, name: str, hidden: str, number: int) -> str:
        heads = self._shape.heads
        size = self._shape.width // heads

        def attend(joint: str) -> str:
            joint = self.node("Reshape", [joint, self.integers("by_head", -1, 3 * heads, 1, size)])
            parts = [f"{name}.{part}" for part in ("query", "key", "value")]
            query, key, value = self.split(joint, parts, axis=1)
            for kind, current in (("keys", key), ("values", value)):
                of_layer = self.integers("of_layer", -1, 1, heads, size)
                self.node("Reshape", [current, of_layer], f"{kind}_{number}_current")
            attended = self._attention(query, key, value, number)
            return self.node("Reshape", [attended, self.integers("in_a_row", -1, heads * size)])

        return self.layer(hidden, self._parameters, name, attend)

    def _attention(self, query: str, key: str, value: str, number: int) -> str:
        """Attend to the past and to the position itself: (rows, heads, 1, size)."""
        last = self.integers("last_axis", -1)
        scale = (self._shape.width // self._shape.heads) ** -0.5
        keys, values = (self.floats_of(f"{kind}_{number}") for kind in ("keys", "values"))
        past = self.node("FusedMatMul", [query, keys], domain=DOMAIN, transB=1, alpha=scale)
        past = self.node("Add", [past, "past_mask"])
        current = self.node("ReduceSum", [self.node("Mul", [query, key]), last], keepdims=1)
        place = np.where(np.arange(WINDOW) == WINDOW - 1, np.float32(scale), np.float32(0))
        current = self.node("Mul", [current, self.constant("current_slot", place)])
        weights = self.node("Softmax", [self.node("Add", [past, current])], axis=-1)
        attended = self.node("MatMul", [weights, values])
        ends = [self.integers("before_last", WINDOW - 1), self.integers("after_last", WINDOW)]
        current = self.node("Slice", [weights, *ends, last])
        return self.node("Add", [attended, self.node("Mul", [current, value])])

    def _outputs(self, hidden: str, number: int) -> str:
        """Compute the selected output layer, if its number is at least ``number``."""
        shape = self._shape
        if number == len(shape.look_aheads):
            nothing = numpy_helper.from_array(np.zeros((0, 2, shape.num_states), np.float32))
            return self.node("Constant", [], value=nothing)
        is_selected = self.node(
            "Equal", ["output_layer", self.constant(f"number_{number}", np.array(number))]
        )

        def write_output() -> str:
            logits = self.product(hidden, self._parameters, f"outputs.{number}")
            by_frame = self.integers("by_frame", -1, 2, shape.num_states)
            return self.node("LogSoftmax", [self.node("Reshape", [logits, by_frame])], axis=-1)

        shape_of_rows = ("some_rows", 2, shape.num_states)
        branches = {
            "then_branch": self.branch(f"output_{number}", write_output, *shape_of_rows),
            "else_branch": self.branch(
                f"not_{number}", lambda: self._outputs(hidden, number + 1), *shape_of_rows
            ),
        }
        return self.node("If", [is_selected], **branches)
