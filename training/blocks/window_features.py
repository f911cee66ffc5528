"""What the first readout reads: Whisper's encoder as it is, on windows, run by onnxruntime.

The graph computes ``kouxing.training.neural.teacher.WholeEncoder`` on a window of at most 2.5 s.

================ ==================================================== =====================
symbol           meaning                                              shape
================ ==================================================== =====================
frames           log-mel frames of the window, oldest first           (frames, 80)
features         positions after the kept layers                      (positions, features)
================ ==================================================== =====================

Position ``p`` has the frames ``2 p`` and ``2 p + 1``, the second of which may be one too many.
A product's input is rounded with one scale for the whole window (onnxruntime's
DynamicQuantizeMatMul). Convolutions, norms and attention are floats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from kouxing.services.recognizer.acoustic.network import open_session, position_table
from kouxing.services.recognizer.front_end.whisper_mel import FLOOR_BANDS, NUM_MELS
from kouxing.training.blocks.readout import MAX_WINDOW_FRAMES
from kouxing.training.neural.onnx_graph import DOMAIN, Floats, Graph, arrays_of, floats
from kouxing.training.neural.teacher import WholeEncoder


def encode_by(encoder: WholeEncoder) -> Callable[[Floats], Floats]:
    """Make a function from a window's frames, (frames, 80), to features, (positions, features)."""
    graph = _WindowGraph(encoder)
    graph.node("Identity", [graph.features()], "features")
    output = floats("features", "positions", len(encoder.kept_layers) * encoder.shape.width)
    session = open_session(graph.file("window", [floats("frames", "frames", NUM_MELS)], [output]))

    def encode(frames: Floats) -> Floats:
        features: Floats = session.run(None, {"frames": frames})[0]
        return features

    return encode


class _WindowGraph(Graph):
    def __init__(self, encoder: WholeEncoder) -> None:
        super().__init__()
        self._encoder = encoder
        self._parameters = arrays_of(encoder)

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
        return self.node("Squeeze", [joined, self.integers("batch_axis", 0)])

    def _front(self) -> str:
        """Limit the bands, run both convolutions and add the positions."""
        loudest = self.node("ReduceMax", ["frames"], keepdims=0)
        floor = self.node("Sub", [loudest, self.number("floor", FLOOR_BANDS)])
        bands = self.node("Transpose", [self.node("Max", ["frames", floor])], perm=[1, 0])
        bands = self.node("Unsqueeze", [bands, self.integers("batch_axis", 0)])
        for name, stride in (("first", 1), ("second", 2)):
            names = [
                self.halves(f"{name}.{kind}", self._parameters[f"{name}.{kind}"])
                for kind in ("weight", "bias")
            ]
            convolved = self.node("Conv", [bands, *names], pads=[1, 1], strides=[stride])
            bands = self.node("Gelu", [convolved])
        hidden = self.node("Transpose", [bands], perm=[0, 2, 1])
        table = position_table(self._encoder.shape.width)[: MAX_WINDOW_FRAMES // 2]
        rows = self.node("Shape", [hidden], start=1, end=2)
        zero = self.integers("zero", 0)
        used = self.node("Slice", [self.constant("positions", table), zero, rows, zero])
        return self.node("Add", [hidden, used])

    def _layer(self, name: str, hidden: str) -> str:
        parameters = self._parameters
        normed = self.norm(hidden, parameters, f"{name}.attention_norm")
        joint = self.product(normed, parameters, f"{name}.query_key_value")
        parts = self.split(joint, [f"{name}.{part}" for part in ("query", "key", "value")])
        heads = self._encoder.shape.heads
        seen = self.node("MultiHeadAttention", parts, domain=DOMAIN, num_heads=heads)
        hidden = self.node("Add", [hidden, self.product(seen, parameters, f"{name}.attended")])
        normed = self.norm(hidden, parameters, f"{name}.inner_norm")
        inner = self.node("Gelu", [self.product(normed, parameters, f"{name}.inner")])
        return self.node("Add", [hidden, self.product(inner, parameters, f"{name}.outer")])

    def product(
        self, inputs: str, parameters: Mapping[str, Floats], name: str, rows: str = ""
    ) -> str:
        """Multiply with a weight in 8 bits and add a bias; the inputs have one scale."""
        integers, scales = self.weight(parameters, name)
        bias = self.constant(f"{name}.bias", parameters[f"{name}.bias"])
        names = [inputs, integers, scales, "", bias]
        return self.node("DynamicQuantizeMatMul", names, domain=DOMAIN)
