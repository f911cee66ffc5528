"""Write trained networks as ONNX, the form in which the recognizer runs them; read them again.

The graph is what :class:`training.network.Network` computes, a chunk of frames at a time with the
recurrent layers' states coming in and going out, and the output layer chosen by its number. Several
networks become one: side by side, the logits' mean in the end (Hansen and Salamon 1990, "Neural
network ensembles"). Weights are kept as 16-bit floats, which halves the file; the sums are in 32
bits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from training.network import FRONT_FRAMES, NUM_INPUTS, Network, Shape

_OPERATORS = 17  # version of the ONNX operator set
_FORMAT = 8  # version of the ONNX file format
_LARGEST_INTEGER = 127
_LEAST_SCALE = 1e-12


def onnx_of(networks: Sequence[Network], *, second_task: bool = False) -> NDArray[np.uint8]:
    """Return the bytes of an ONNX file.

    Its inputs are ``x`` (frames, batch, 205), the last five frames, oldest first; ``h1`` and ``h2``
    (1, batch, networks H), the states of the recurrent layers; and ``head``, the number of the
    output layer. Its outputs are log shares (frames, batch, states) and the new states.

    Parameters
    ----------
    networks
        Networks of one shape.
    second_task
        Offer the output layer of the second task instead of the others.
    """
    shape = networks[0].shape
    parameters = [
        {name: tensor.numpy() for name, tensor in one.state_dict().items()} for one in networks
    ]
    heads = [f"heads.{head}" for head in range(len(shape.look_aheads))]
    if second_task:
        heads = ["second_task"]
    fronts = [one["front.weight"].transpose(2, 1, 0) for one in parameters]
    weights = {
        "front_weight": _beside([front.reshape(-1, shape.front) for front in fronts]),
        "front_bias": _beside([one["front.bias"] for one in parameters]),
        "head_weight": np.stack(
            [np.concatenate([one[f"{head}.weight"].T for one in parameters]) for head in heads]
        ),
        "head_bias": np.stack(
            [np.sum([one[f"{head}.bias"] for one in parameters], axis=0) for head in heads]
        ),
    }
    for number, one in enumerate(parameters):
        weights |= _recurrent("first", number, one) | _recurrent("second", number, one)
    stored = [_stored(name, array) for name, array in weights.items()]
    constants = [
        numpy_helper.from_array(np.array([1]), "axis"),
        numpy_helper.from_array(np.array(len(networks), np.float32), "networks"),
    ]
    numbers = range(len(networks))
    nodes = [
        *(node for _, made in stored for node in made),
        helper.make_node("MatMul", ["x", "front_weight"], ["front_product"]),
        helper.make_node("Add", ["front_product", "front_bias"], ["front_sum"]),
        helper.make_node("Relu", ["front_sum"], ["front"]),
        *(_split(name, numbers) for name in ("front", "h1", "h2")),
        *(node for number in numbers for node in _layers(number, shape.hidden)),
        *(_joined(f"h{layer}_after", numbers) for layer in (1, 2)),
        helper.make_node(
            "Concat", [f"{n}_{k}" for k in numbers for n in ("first", "second")], ["both"], axis=2
        ),
        helper.make_node("Gather", ["head_weight", "head"], ["weight"], axis=0),
        helper.make_node("Gather", ["head_bias", "head"], ["bias"], axis=0),
        helper.make_node("MatMul", ["both", "weight"], ["product"]),
        helper.make_node("Add", ["product", "bias"], ["sum"]),
        helper.make_node("Div", ["sum", "networks"], ["logits"]),
        helper.make_node("LogSoftmax", ["logits"], ["log_share"], axis=-1),
    ]
    state: list[int | str] = [1, "batch", len(networks) * shape.hidden]
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
        initializer=[*(tensor for tensors, _ in stored for tensor in tensors), *constants],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPERATORS)])
    model.ir_version = _FORMAT
    onnx.checker.check_model(model)
    return np.frombuffer(model.SerializeToString(), dtype=np.uint8)


def networks_of(file: NDArray[np.uint8], look_aheads: Sequence[int]) -> list[Network]:
    """Return the networks in an ONNX file that :func:`onnx_of` has made, to train them further.

    The output layer of a second task is not in the file: it begins anew.

    Parameters
    ----------
    file
        Its bytes.
    look_aheads
        Of its output layers, feature frames.

    Raises
    ------
    KeyError
        If the file is none of these.
    """
    stored = {
        tensor.name: numpy_helper.to_array(tensor)
        for tensor in onnx.load_model_from_string(file.tobytes()).graph.initializer
    }
    weights = {name: array for name, array in stored.items() if "bias" in name} | {
        name.removesuffix("_8"): array * stored[f"{name.removesuffix('_8')}_scale"]
        for name, array in stored.items()
        if name.endswith("_8")
    }
    num_networks = int(stored["networks"])
    fronts = np.split(weights["front_weight"], num_networks, axis=-1)
    front_biases = np.split(weights["front_bias"], num_networks)
    heads = np.split(weights["head_weight"], num_networks, axis=1)
    head_biases = weights["head_bias"] / num_networks
    networks = []
    for number in range(num_networks):
        front = fronts[number].reshape(FRONT_FRAMES, NUM_INPUTS, -1).transpose(2, 1, 0)
        shape = Shape(
            num_states=head_biases.shape[1],
            look_aheads=tuple(look_aheads),
            front=len(front),
            hidden=heads[number].shape[1] // 2,
        )
        parameters = {"front.weight": front, "front.bias": front_biases[number]}
        for layer in ("first", "second"):
            parameters[f"{layer}.weight_ih_l0"] = _swapped(weights[f"{layer}_input_{number}"][0])
            parameters[f"{layer}.weight_hh_l0"] = _swapped(weights[f"{layer}_state_{number}"][0])
            of_input, of_state = np.split(weights[f"{layer}_bias_{number}"][0], 2)
            parameters[f"{layer}.bias_ih_l0"] = _swapped(of_input)
            parameters[f"{layer}.bias_hh_l0"] = _swapped(of_state)
        for head in range(len(look_aheads)):
            parameters[f"heads.{head}.weight"] = heads[number][head].T
            parameters[f"heads.{head}.bias"] = head_biases[head]
        network = Network(shape)
        network.load_state_dict(
            {name: torch.from_numpy(array.copy()) for name, array in parameters.items()}
            | {f"second_task.{k}": v for k, v in network.second_task.state_dict().items()}
        )
        networks.append(network)
    return networks


def _beside(arrays: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    return np.concatenate(arrays, axis=-1)


def _stored(
    name: str, array: NDArray[np.float32]
) -> tuple[list[onnx.TensorProto], list[onnx.NodeProto]]:
    """Keep weights in 8 bits: return what stands in the file, and what makes floats of it.

    onnxruntime does this once, when it loads the file.
    """
    if "bias" in name:
        return [numpy_helper.from_array(array, name)], []
    summed = -1 if name.startswith(("first", "second")) else -2  # axis that a product sums over
    scale = np.abs(array).max(axis=summed, keepdims=True) / _LARGEST_INTEGER
    integers = np.rint(array / np.maximum(scale, _LEAST_SCALE)).astype(np.int8)
    tensors = [
        numpy_helper.from_array(integers, f"{name}_8"),
        numpy_helper.from_array(scale, f"{name}_scale"),
    ]
    nodes = [
        helper.make_node("Cast", [f"{name}_8"], [f"{name}_whole"], to=TensorProto.FLOAT),
        helper.make_node("Mul", [f"{name}_whole", f"{name}_scale"], [name]),
    ]
    return tensors, nodes


def _value(name: str, shape: list[int | str]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def _split(name: str, numbers: Sequence[int]) -> onnx.NodeProto:
    """Give every network its part of what stands side by side."""
    return helper.make_node("Split", [name], [f"{name}_{number}" for number in numbers], axis=2)


def _joined(name: str, numbers: Sequence[int]) -> onnx.NodeProto:
    return helper.make_node("Concat", [f"{name}_{number}" for number in numbers], [name], axis=2)


def _recurrent(
    name: str, number: int, parameters: dict[str, NDArray[np.float32]]
) -> dict[str, NDArray[np.float32]]:

    def swapped(kind: str) -> NDArray[np.float32]:
        return _swapped(parameters[f"{name}.{kind}_l0"])[None]

    return {
        f"{name}_input_{number}": swapped("weight_ih"),
        f"{name}_state_{number}": swapped("weight_hh"),
        f"{name}_bias_{number}": np.concatenate([swapped("bias_ih"), swapped("bias_hh")], axis=1),
    }


def _swapped(gates: NDArray[np.float32]) -> NDArray[np.float32]:
    """Change between ONNX's order of the gates (update, reset, new) and PyTorch's (reset first)."""
    first, second, new = np.split(gates, 3)
    return np.concatenate([second, first, new])


def _layers(number: int, hidden: int) -> list[onnx.NodeProto]:
    """Both recurrent layers of a network."""
    nodes = []
    for name, below, state in (("first", "front", "h1"), ("second", "first", "h2")):
        weights = [f"{name}_{kind}_{number}" for kind in ("input", "state", "bias")]
        inputs = [f"{below}_{number}", *weights, "", f"{state}_{number}"]
        outputs = [f"{name}_directions_{number}", f"{state}_after_{number}"]
        nodes += [
            helper.make_node("GRU", inputs, outputs, hidden_size=hidden, linear_before_reset=1),
            helper.make_node("Squeeze", [outputs[0], "axis"], [f"{name}_{number}"]),
        ]
    return nodes
