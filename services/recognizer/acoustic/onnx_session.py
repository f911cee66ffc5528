"""Opens ONNX files with onnxruntime, on one thread.

Telemetry is disabled: onnxruntime would store usage data and send it to its maker. The telemetry
thread can also keep a process from ending (onnxruntime-genai, pull request 2363).

Integer products are exact on every processor. By default, their partial sums overflow on x86
processors without VNNI instructions (onnxruntime, issue 14642). In conversation, a third of the
phones would then be wrong, instead of a fifth. The option that prevents this overflow slows down
other processors by a third.
"""

import os
from functools import cache
from typing import Any

import numpy as np

os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # read during the import
import onnxruntime

# An ONNX model with one MatMulInteger node: c = a @ b; a is uint8, (1, 2), and b is int8, (2, 1).
_PRODUCT = (
    b'\x08\x04:[\n\x18\n\x01a\n\x01b\x12\x01c"\rMatMulInteger\x12\x00'
    b"Z\x13\n\x01a\x12\x0e\n\x0c\x08\x02\x12\x08\n\x02\x08\x01\n\x02\x08\x02"
    b"Z\x13\n\x01b\x12\x0e\n\x0c\x08\x03\x12\x08\n\x02\x08\x02\n\x02\x08\x01"
    b"b\x13\n\x01c\x12\x0e\n\x0c\x08\x06\x12\x08\n\x02\x08\x01\n\x02\x08\x01B\x04\n\x00\x10\n"
)


def create_inference_session(file: bytes) -> Any:
    """Return an ``onnxruntime.InferenceSession``; its errors have no common base class."""
    options = _create_options()
    if _products_overflow():
        options.add_session_config_entry("session.x64quantprecision", "1")
    return onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])


def _create_options() -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # an arena would keep 2.4 MB per session
    options.log_severity_level = 3  # only errors: a constant that is an input causes warnings
    return options


@cache
def _products_overflow() -> bool:
    """Return whether the default integer products of this processor overflow."""
    session = onnxruntime.InferenceSession(
        _PRODUCT, _create_options(), providers=["CPUExecutionProvider"]
    )
    a, b = np.full((1, 2), 255, np.uint8), np.full((2, 1), 127, np.int8)
    (product,) = session.run(None, {"a": a, "b": b})
    return bool(product.item() != 2 * 255 * 127)
