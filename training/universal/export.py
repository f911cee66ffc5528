"""Exports the universal readout as an extension of the block network's ONNX file.

The extension is a part of an ONNX file. Appended to the bytes of the block network, it adds the
readout's nodes, an input and two outputs, because joined protocol buffers merge their lists. The
readout's inputs are hidden layers of the block network, so one run computes both.
"""

from collections.abc import Sequence

import numpy as np
import onnx
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.blocks import EXTENSION_PREFIX, BlockModel
from kouxing.training.blocks.export import ReadoutGraph
from kouxing.training.blocks.network import BlockReadout
from kouxing.training.networks.teacher import KEPT_LAYERS


def export_extension(
    readout: BlockReadout, model: BlockModel, layers: Sequence[int]
) -> NDArray[np.uint8]:
    """Export a readout of some layers, which must be among those that the model's readout reads."""
    sizes = model.runner.sizes
    network = onnx.load_from_string(model.network.tobytes()).graph
    standardized = next(node for node in network.node if "readout.mean" in node.input)
    joined = next(node for node in network.node if standardized.input[0] in node.output)
    kept = [joined.input[KEPT_LAYERS.index(layer)] for layer in layers]
    graph = ReadoutGraph(readout, sizes.block, sizes.length, EXTENSION_PREFIX)
    graph.log_posteriors(graph.node("Concat", kept, axis=-1))
    return graph.extension([graph.state], graph.outputs)
