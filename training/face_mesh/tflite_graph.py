"""Convolutional networks of TensorFlow Lite as ONNX graphs.

Only the operators that MediaPipe's face detector and face mesh have. TensorFlow Lite keeps images
as (1, height, width, channels), ONNX as (1, channels, height, width): inputs and outputs of the
graph are as in TensorFlow Lite, between them all is as in ONNX.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import tflite
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

OPSET = 17

_IMAGE_AXES = (0, 3, 1, 2)  # from TensorFlow Lite to ONNX
_PADDING = {tflite.Padding.SAME: "SAME_UPPER", tflite.Padding.VALID: "VALID"}
_CODES = {code: name for name, code in vars(tflite.BuiltinOperator).items() if name.isupper()}


def onnx_model(content: bytes, name: str) -> onnx.ModelProto:
    """Convert a model file; ValueError names an operator or option that is not known here."""
    model = tflite.Model.GetRootAsModel(content, 0)
    graph = _Graph(model)
    for index in range(graph.source.OperatorsLength()):
        graph.add(graph.source.Operators(index))
    made = helper.make_graph(
        graph.nodes, name, [*graph.inputs()], [*graph.outputs()], initializer=graph.weights
    )
    result = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    onnx.checker.check_model(result, full_check=True)
    return result


class _Graph:
    """The ONNX graph under way; tensors are named by their numbers in TensorFlow Lite."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self.source = model.Subgraphs(0)
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []
        self._halves: dict[int, NDArray[Any]] = {}  # what is still to be made 32-bit

    def inputs(self) -> list[onnx.ValueInfoProto]:
        """Return the graph's inputs and transpose them."""
        infos = []
        for tensor in self.source.InputsAsNumpy():
            transposed = helper.make_node(
                "Transpose", [f"input{tensor}"], [f"{tensor}"], perm=_IMAGE_AXES
            )
            self.nodes.insert(0, transposed)
            infos.append(self._info(tensor, f"input{tensor}"))
        return infos

    def outputs(self) -> list[onnx.ValueInfoProto]:
        """Return the graph's outputs, laid out as in TensorFlow Lite."""
        infos = []
        for tensor in self.source.OutputsAsNumpy():
            is_image = len(self._shape(tensor)) == 4
            self._node("Transpose" if is_image else "Identity", [f"{tensor}"], f"output{tensor}",
                       **({"perm": (0, 2, 3, 1)} if is_image else {}))  # fmt: skip
            infos.append(self._info(tensor, f"output{tensor}"))
        return infos

    def add(self, operator: Any) -> None:
        """Add an operator."""
        code = self._model.OperatorCodes(operator.OpcodeIndex())
        kind = _CODES[max(code.BuiltinCode(), code.DeprecatedBuiltinCode())]
        inputs = [int(tensor) for tensor in operator.InputsAsNumpy()]
        output = int(operator.Outputs(0))
        convert = getattr(self, f"_{kind.lower()}", None)
        if convert is None:
            raise ValueError(f"the operator {kind} is not known")
        convert(operator, inputs, output)

    def _dequantize(self, _operator: Any, inputs: list[int], output: int) -> None:
        self._halves[output] = self._constant(inputs[0], np.float16)

    def _conv_2d(self, operator: Any, inputs: list[int], output: int) -> None:
        options = _options(operator, tflite.Conv2DOptions)
        kernel = self._halves[inputs[1]].transpose(_IMAGE_AXES)  # out, height, width, in
        self._convolution(options, kernel, 1, inputs, output)

    def _depthwise_conv_2d(self, operator: Any, inputs: list[int], output: int) -> None:
        options = _options(operator, tflite.DepthwiseConv2DOptions)
        kernel = self._halves[inputs[1]].transpose(3, 0, 1, 2)  # 1, height, width, channels
        self._convolution(options, kernel, len(kernel), inputs, output)

    def _convolution(
        self, options: Any, kernel: NDArray[Any], num_groups: int, inputs: list[int], output: int
    ) -> None:
        bias = self._weight(f"bias{output}", self._halves[inputs[2]])
        self._node(
            "Conv",
            [f"{inputs[0]}", self._weight(f"kernel{output}", kernel), bias],
            f"{output}",
            group=num_groups,
            auto_pad=_PADDING[options.Padding()],
            strides=(options.StrideH(), options.StrideW()),
        )

    def _max_pool_2d(self, operator: Any, inputs: list[int], output: int) -> None:
        options = _options(operator, tflite.Pool2DOptions)
        self._node(
            "MaxPool",
            [f"{inputs[0]}"],
            f"{output}",
            kernel_shape=(options.FilterHeight(), options.FilterWidth()),
            auto_pad=_PADDING[options.Padding()],
            strides=(options.StrideH(), options.StrideW()),
        )

    def _prelu(self, _operator: Any, inputs: list[int], output: int) -> None:
        slope = self._halves[inputs[1]].transpose(2, 0, 1)  # 1, 1, channels
        self._node("PRelu", [f"{inputs[0]}", self._weight(f"slope{output}", slope)], f"{output}")

    def _relu(self, _operator: Any, inputs: list[int], output: int) -> None:
        self._node("Relu", [f"{inputs[0]}"], f"{output}")

    def _add(self, operator: Any, inputs: list[int], output: int) -> None:
        _options(operator, tflite.AddOptions)
        self._node("Add", [f"{each}" for each in inputs], f"{output}")

    def _pad(self, _operator: Any, inputs: list[int], output: int) -> None:
        pads = self._constant(inputs[1], np.int32)[list(_IMAGE_AXES)]  # before and after each axis
        amounts = self._weight(f"pads{output}", pads.T.ravel().astype(np.int64))
        self._node("Pad", [f"{inputs[0]}", amounts], f"{output}")

    def _reshape(self, _operator: Any, inputs: list[int], output: int) -> None:
        shape = self._weight(f"shape{output}", np.array(self._shape(output), np.int64))
        self._node("Transpose", [f"{inputs[0]}"], f"rows{output}", perm=(0, 2, 3, 1))
        self._node("Reshape", [f"rows{output}", shape], f"{output}")

    def _concatenation(self, operator: Any, inputs: list[int], output: int) -> None:
        options = _options(operator, tflite.ConcatenationOptions)
        self._node("Concat", [f"{each}" for each in inputs], f"{output}", axis=options.Axis())

    def _node(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> None:
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))

    def _weight(self, name: str, values: NDArray[Any]) -> str:
        """Store a constant, 16-bit floats with their cast to 32 bits; return its name."""
        stored = numpy_helper.from_array(np.ascontiguousarray(values), name)
        self.weights.append(stored)
        if values.dtype == np.float16:
            self._node("Cast", [name], f"{name}.32", to=TensorProto.FLOAT)
            return f"{name}.32"
        return name

    def _constant(self, tensor: int, kind: type[np.generic]) -> NDArray[Any]:
        content = self._model.Buffers(self.source.Tensors(tensor).Buffer()).DataAsNumpy()
        return np.frombuffer(content, kind).reshape(self._shape(tensor))

    def _shape(self, tensor: int) -> tuple[int, ...]:
        return tuple(int(size) for size in self.source.Tensors(tensor).ShapeAsNumpy())

    def _info(self, tensor: int, name: str) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, self._shape(tensor))


def _options(operator: Any, kind: Any) -> Any:
    """Return an operator's options; ValueError if it has an activation function."""
    table = operator.BuiltinOptions()
    options = kind()
    options.Init(table.Bytes, table.Pos)
    if options.FusedActivationFunction() != tflite.ActivationFunctionType.NONE:
        raise ValueError(f"{kind.__name__}: the activation function is not known")
    return options
