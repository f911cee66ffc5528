"""Exports the block network to ONNX; the recognizer runs it one block at a time.

The graph computes :class:`kouxing.training.blocks.network.BlockEncoder` and its readout for a block
and its right context, for several sessions. Each has room for ``B + R`` positions, and fewer
positions where its speech starts and ends.

=============== ================================================== =============================
symbol          meaning                                            shape
=============== ================================================== =============================
frames          log-mel frames, oldest first, two before the first (sessions, 2 (B + R) + 3, 80)
                position's
positions       rows of the table of positions                     (sessions, B + R, width)
num_positions   number of positions, 1 or more                     (sessions,)
num_cached      positions in the caches                            (sessions,)
state           state of the recurrent layer before the block      (sessions, GRU's width)
keys_l,         of the positions before the block, for each layer; (sessions, heads, PAST, size)
values_l        16-bit floats
log_posteriors  log posteriors of the states of two frames each    (sessions, 2 (B + R), states)
new_state       state after the block                              (sessions, GRU's width)
new             keys and values of the block, in the order of the  (sessions, 2 layers, heads,
                inputs, 16-bit floats                              B, size)
=============== ================================================== =============================

Products use 8-bit integers (:mod:`kouxing.training.networks.onnx_graph`). Norms, attention and the
recurrent layer use floats. onnxruntime may sum a product with a single row in another order. The
recurrent layer has one row for each session, so the first session's row is repeated.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
import onnx
from onnx import TensorProto, helper

from kouxing.services.recognizer.acoustic.blocks import cache_names
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.shared.arrays import Floats, UInt8
from kouxing.training.blocks.network import PAST, RIGHT_CONTEXT, BlockEncoder, BlockReadout
from kouxing.training.networks.network import MAX_DEVIATIONS
from kouxing.training.networks.onnx_graph import DOMAIN, Graph, floats, halves, module_arrays
from kouxing.training.networks.teacher import KEPT_LAYERS

_LAST_OF_BLOCK = "last_of_block"


def export_onnx(
    encoder: BlockEncoder,
    readout: BlockReadout,
    block_length: int,
    right_context: int = RIGHT_CONTEXT,
    past: int = PAST,
) -> UInt8:
    """Export a network as the bytes of an ONNX file with the inputs and outputs above."""
    return BlockGraph(encoder, readout, block_length, right_context, past).file_of_block()


class ReadoutGraph(Graph):
    """The graph of a readout. With ``readout`` None, the network has no readout.

    With a prefix, it extends the graph of another readout: both keep equally many positions.
    """

    def __init__(
        self, readout: BlockReadout | None, block: int, length: int, prefix: str = ""
    ) -> None:
        super().__init__(prefix)
        self.block, self.length = block, length
        self._readout = module_arrays(readout, "readout.") if readout else {}

    @property
    def state(self) -> onnx.ValueInfoProto:
        """Describe the input of the recurrent layer's state."""
        return floats(f"{self.prefix}state", "sessions", self._gru_width)

    @property
    def outputs(self) -> list[onnx.ValueInfoProto]:
        """Describe the readout's outputs."""
        rows = 2 * self.length
        return [
            floats(f"{self.prefix}log_posteriors", "sessions", rows, self._num_states),
            floats(f"{self.prefix}new_state", "sessions", self._gru_width),
        ]

    @property
    def _gru_width(self) -> int:
        return int(self._readout["readout.gru.weight_hh_l0"].shape[1])

    @property
    def _num_states(self) -> int:
        return len(self._readout["readout.output.bias"]) // 2

    def log_posteriors(self, features: str) -> None:
        """Run the readout on (rows, features)."""
        parameters, length, states = self._readout, self.length, self._num_states
        inner = self._inner(features)
        context = self._context(inner)
        both = self.node("Concat", [context, inner], axis=-1)
        logits = self.product(both, parameters, "readout.output")
        by_frame = self.integers("by_frame", -1, 2 * length, states)
        logits = self.node("Reshape", [logits, by_frame])
        self.node("LogSoftmax", [logits], f"{self.prefix}log_posteriors", axis=-1)

    def _inner(self, features: str) -> str:
        """Compute the recurrent layer's input: (rows, features) to (rows, inner)."""
        parameters = self._readout
        mean = self.constant("readout.mean", parameters["readout.mean"])
        inverse = self.constant("readout.inverse", 1 / parameters["readout.deviation"])
        limits = [self.number(f"limit_{sign}", sign * MAX_DEVIATIONS) for sign in (-1, 1)]
        standard = self.node("Mul", [self.node("Sub", [features, mean]), inverse])
        standard = self.node("Clip", [standard, *limits])
        return self.node("Gelu", [self.product(standard, parameters, "readout.inner")])

    def _context(self, inner: str) -> str:
        """Run the recurrent layer both ways: (rows, inner) to (rows, 2 width)."""
        parameters, length = self._readout, self.length
        width = self._gru_width
        by_session = self.integers("by_session", -1, length, len(parameters["readout.inner.bias"]))
        rows_by_session = self.node("Reshape", [inner, by_session])
        in_order = self.node("Transpose", [rows_by_session], perm=[1, 0, 2])
        zero, one = self.integers("zero", 0), self.integers("one_row", 1)
        repeated = []  # with the first session's row once more
        for values, axis in ((in_order, 1), ("num_positions", 0), (f"{self.prefix}state", 0)):
            first = self.node("Slice", [values, zero, one, self.integers(f"axis_{axis}", axis)])
            repeated.append(self.node("Concat", [values, first], axis=axis))
        inputs, num_positions, state = repeated
        counts = self.node("Cast", [num_positions], to=TensorProto.INT32)
        nothing = self.node("Mul", [state, self.number("nothing", 0.0)])
        directions = [self.node("Unsqueeze", [start, zero]) for start in (state, nothing)]
        states = self.node("Concat", directions, axis=0)
        context = self.node(
            "GRU",
            [inputs, *self._recurrent_weights(), counts, states],
            hidden_size=width,
            direction="bidirectional",
            linear_before_reset=1,
        )
        sessions = [zero, self.integers("before_last", -1), self.integers("place_axis", 2)]
        context = self.node("Slice", [context, *sessions])
        context = self.node("Transpose", [context], perm=[2, 0, 1, 3])  # sessions, n, directions
        last = _LAST_OF_BLOCK
        if not self.prefix:
            self.constant(last, np.array(self.block - 1))
        state = self.node("Gather", [context, last], axis=1)
        first = self.constant("first", np.array(0))
        self.node("Gather", [state, first], f"{self.prefix}new_state", axis=1)
        return self.node("Reshape", [context, self.integers("both", -1, 2 * width)])

    def _recurrent_weights(self) -> list[str]:

        def gates(kind: str) -> Floats:
            ends = ("", "_reverse")
            return np.stack([_gates(self._readout[f"readout.gru.{kind}_l0{end}"]) for end in ends])

        biases = np.hstack([gates("bias_ih"), gates("bias_hh")])
        return [
            self.halves("readout.input_weights", gates("weight_ih")),
            self.halves("readout.recurrent_weights", gates("weight_hh")),
            self.constant("readout.biases", biases),
        ]


class BlockGraph(ReadoutGraph):
    """The graph of the encoder, and of its readout."""

    def __init__(
        self,
        encoder: BlockEncoder,
        readout: BlockReadout | None,
        block_length: int,
        right_context: int,
        past: int,
    ) -> None:
        super().__init__(readout, block_length, block_length + right_context)
        self._shape = encoder.shape
        self._size = encoder.shape.width // encoder.shape.heads
        self._encoder = module_arrays(encoder)
        self._past = past
        self._new: list[str] = []  # keys and values of the block

    def file_of_block(self) -> UInt8:
        """Add all nodes; return the ONNX file."""
        self.log_posteriors(self.features(KEPT_LAYERS))
        self.new_caches()
        return self.file("blocks", self.inputs(self.state), [*self.outputs, self.new])

    def inputs(self, *more: onnx.ValueInfoProto) -> list[onnx.ValueInfoProto]:
        """Describe the inputs; ``more`` precede the caches."""
        shape, length = self._shape, self.length
        caches = [
            halves(name, "sessions", shape.heads, self._past, self._size)
            for name in cache_names(shape.layers)
        ]
        return [
            floats("frames", "sessions", 2 * length + 3, NUM_MELS),
            floats("positions", "sessions", length, shape.width),
            *(
                helper.make_tensor_value_info(name, TensorProto.INT64, ["sessions"])
                for name in ("num_positions", "num_cached")
            ),
            *more,
            *caches,
        ]

    def new_caches(self) -> None:
        """Output the block's keys and values."""
        order = [
            self._new[layer + index]
            for index in range(2)
            for layer in range(0, 2 * self._shape.layers, 2)
        ]
        new = self.node("Concat", order, axis=1)
        self.node("Cast", [new], "new", to=TensorProto.FLOAT16)

    @property
    def new(self) -> onnx.ValueInfoProto:
        """Describe the output of keys and values."""
        rings = 2 * self._shape.layers
        return halves("new", "sessions", rings, self._shape.heads, self.block, self._size)

    def features(self, kept_layers: Sequence[int]) -> str:
        """Run the encoder; the kept layers of all positions, (rows, features)."""
        width = self._shape.width
        hidden = self.convolutions("frames", self._encoder, self.length)
        rows = self.node("Reshape", ["positions", self.integers("rows", -1, width)])
        hidden = self.node("Add", [hidden, rows])
        mask = self._mask()
        after = []
        for number in range(self._shape.layers):
            attend = partial(self._attention, number, mask)
            hidden = self.layer(hidden, self._encoder, f"layers.{number}", attend)
            after.append(hidden)
        return self.node("Concat", [after[place] for place in kept_layers], axis=-1)

    def _mask(self) -> str:
        """Return the attention mask: of the cached positions, then of the block's."""
        parts = []
        for name, limit in (("num_cached", self._past), ("num_positions", self.length)):
            count = self.node("Unsqueeze", [name, self.integers("three_axes", 1, 2, 3)])
            is_present = self.node("Less", [self.integers(f"{name}.places", *range(limit)), count])
            limits = [self.number("may", 0.0), self.number("may_not", -np.inf)]
            parts.append(self.node("Where", [is_present, *limits]))
        return self.node("Concat", parts, axis=-1)

    def _attention(self, number: int, mask: str, joint: str) -> str:
        """Attend to the cached positions and to the block's, (rows, width)."""
        heads, size, width = self._shape.heads, self._size, self._shape.width
        name = f"layers.{number}"
        parts = self.split(joint, [f"{name}.{part}" for part in ("query", "key", "value")])
        by_head = self.integers("by_head", -1, self.length, heads, size)
        query, key, value = (
            self.node("Transpose", [self.node("Reshape", [part, by_head])], perm=[0, 2, 1, 3])
            for part in parts
        )
        ends = [self.integers("zero", 0), self.integers("block", self.block)]
        for values in (key, value):
            block_values = self.node("Slice", [values, *ends, self.integers("place_axis", 2)])
            self._new.append(self.node("Unsqueeze", [block_values, self.integers("ring_axis", 1)]))
        old_keys, old_values = (self.floats_of(f"{kind}_{number}") for kind in ("keys", "values"))
        products = [
            self.node("FusedMatMul", [query, keys], domain=DOMAIN, transB=1, alpha=size**-0.5)
            for keys in (old_keys, key)
        ]
        masked = self.node("Add", [self.node("Concat", products, axis=-1), mask])
        weights = self.node("Softmax", [masked], axis=-1)
        names = [f"{name}.{part}_weights" for part in ("past", "block")]
        past, block = self.split(weights, names, self._past, self.length)
        pairs = ((past, old_values), (block, value))
        attended = self.node("Add", [self.node("MatMul", pair) for pair in pairs])
        attended = self.node("Transpose", [attended], perm=[0, 2, 1, 3])
        return self.node("Reshape", [attended, self.integers("rows", -1, width)])


def _gates(stacked: Floats) -> Floats:
    """Reorder PyTorch's gates (reset, update, new) for ONNX (update, reset, new)."""
    reset, update, new = np.split(stacked, 3)
    return np.concatenate([update, reset, new])
