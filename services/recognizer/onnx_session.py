"""Networks are opened in one place: ONNX files, run by onnxruntime on one thread."""

from __future__ import annotations

from typing import Any

import onnxruntime


def open_network(file: bytes) -> Any:
    """Return the ``onnxruntime.InferenceSession`` of an ONNX file; its errors have no base."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # it keeps what the largest batch took, 2.4 MB a session
    return onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
