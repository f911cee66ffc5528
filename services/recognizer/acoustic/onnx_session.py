"""Opens ONNX files with onnxruntime, on one thread.

Telemetry is disabled: onnxruntime would store usage data and send it to its maker. The telemetry
thread can also keep a process from ending (onnxruntime-genai, pull request 2363).

Integer products are exact on every processor. By default, their partial sums overflow on x86
processors without VNNI instructions (onnxruntime, issue 14642). In conversation, a third of the
phones would then be wrong, instead of a fifth.
"""

import os
from typing import Any

os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # read during the import
import onnxruntime


def create_inference_session(file: bytes) -> Any:
    """Return an ``onnxruntime.InferenceSession``; its errors have no common base class."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # an arena would keep 2.4 MB per session
    options.add_session_config_entry("session.x64quantprecision", "1")  # exact products
    options.log_severity_level = 3  # only errors: a constant that is an input causes warnings
    return onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
