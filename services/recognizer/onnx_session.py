"""Opens ONNX files with onnxruntime, on one thread."""

from typing import Any

import onnxruntime


def open_network(file: bytes) -> Any:
    """Return an ``onnxruntime.InferenceSession``; its errors have no common base class."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # an arena would keep 2.4 MB per session
    options.log_severity_level = 3  # only errors: a constant that is an input causes warnings
    return onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
