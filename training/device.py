"""The device that networks are trained on: a GPU if one is available."""

import os

import torch

# The usual check initializes CUDA, after which forked processes could not use it.
os.environ.setdefault("PYTORCH_NVML_BASED_CUDA_CHECK", "1")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def mixed_precision() -> torch.autocast:
    """Use bfloat16 products if the device supports them."""
    faster = DEVICE.type == "cuda" or torch.cpu.get_capabilities().get("avx512_bf16", False)
    return torch.autocast(DEVICE.type, torch.bfloat16, enabled=faster)
