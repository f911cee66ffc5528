"""Networks of acoustic models: ONNX files that onnxruntime runs on one thread."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.onnx_session import create_inference_session
from kouxing.shared.arrays import Floats, UInt8

MAX_POSITIONS = 1500  # rows of the table of positions
FRAMES_PER_ENCODER_FRAME = 2  # feature frames from one encoder frame to the next

_LONGEST_WAVE = 10_000.0  # longest period of the sinusoids, over 2 pi


def position_table(width: int) -> Floats:
    """Return Whisper's table of sinusoidal positions, shape (1500, width)."""
    step = math.log(_LONGEST_WAVE) / (width // 2 - 1)
    phase = np.arange(MAX_POSITIONS)[:, None] * np.exp(-step * np.arange(width // 2))
    return np.concatenate([np.sin(phase), np.cos(phase)], axis=1).astype(np.float32)


def encode_integer_inputs(num_axes: Mapping[str, int]) -> bytes:
    """Return bytes to append to an ONNX file. They turn its integer constants into inputs.

    ``num_axes`` has the axes of each constant, by name; each axis has length 1. Concatenated
    messages of Protocol Buffers are merged, so the bytes add inputs to the file's graph. An input
    with the name of a constant replaces it in a run (ONNX IR, "Graphs"). The package onnx has
    31 MB, and only training needs it.

    Raises ``ValueError`` if all inputs together need 128 bytes or more: each length is one byte.
    """

    def field(number: int, content: bytes) -> bytes:
        if len(content) >= 128:
            raise ValueError(f"the inputs {', '.join(num_axes)} are too long")
        return bytes([number << 3 | 2, len(content)]) + content  # type 2: length and content

    axis, int64 = field(1, bytes([1 << 3, 1])), bytes([1 << 3, 7])
    inputs = b""
    for name, num in num_axes.items():
        tensor = field(1, int64 + field(2, num * axis))
        inputs += field(11, field(1, name.encode()) + field(2, tensor))
    return field(7, inputs)


def open_onnx_session(file: UInt8, inputs: bytes = b"") -> Any:
    """Open a model's ONNX file, given as bytes, with ``encode_integer_inputs``.

    Raises ``ValueError`` if it is not an ONNX file.
    """
    try:
        return create_inference_session(file.tobytes() + inputs)
    except Exception as error:  # onnxruntime's errors have no common base
        raise ValueError(f"its network cannot be read ({error})") from error


def run_onnx_session(session: Any, outputs: list[str], inputs: Mapping[str, NDArray[Any]]) -> Any:
    """Return a network's outputs; ValueError if it does not run."""
    try:
        return session.run(outputs, inputs)
    except Exception as error:
        raise ValueError(f"its network does not run ({error})") from error


def check_outputs(outputs: Sequence[NDArray[Any]], shapes: Sequence[tuple[int, ...]]) -> None:
    """Raise ``ValueError`` if a network's outputs do not have these shapes or are not finite."""
    if [array.shape for array in outputs] != list(shapes):
        raise ValueError(f"its network outputs the shape {outputs[0].shape}, expected {shapes[0]}")
    if not all(np.isfinite(array).all() for array in outputs):
        raise ValueError("its network outputs values that are not finite")
