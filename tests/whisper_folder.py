"""Folders with the weights of a small Whisper, in the layout of faster-whisper."""

import struct
from pathlib import Path

import numpy as np

from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS


def encoder_arrays(num_layers: int = 3, width: int = 32, inner: int = 48) -> dict[str, np.ndarray]:
    """Return random weights of a small encoder, by CTranslate2's names."""
    sizes = {
        "conv1/weight": (width, NUM_MELS, 3),
        "conv1/bias": (width,),
        "conv2/weight": (width, width, 3),
        "conv2/bias": (width,),
        "layer_norm/gamma": (width,),
        "layer_norm/beta": (width,),
    }
    for number in range(num_layers):
        for name, size in {
            "self_attention/layer_norm/gamma": (width,),
            "self_attention/layer_norm/beta": (width,),
            "self_attention/linear_0/weight": (3 * width, width),
            "self_attention/linear_0/bias": (3 * width,),
            "self_attention/linear_1/weight": (width, width),
            "self_attention/linear_1/bias": (width,),
            "ffn/layer_norm/gamma": (width,),
            "ffn/layer_norm/beta": (width,),
            "ffn/linear_0/weight": (inner, width),
            "ffn/linear_0/bias": (inner,),
            "ffn/linear_1/weight": (width, inner),
            "ffn/linear_1/bias": (width,),
        }.items():
            sizes[f"layer_{number}/{name}"] = size
    rng = np.random.default_rng(0)
    return {
        f"encoder/{name}": rng.normal(0, 0.2, size).astype(np.float16)
        for name, size in sizes.items()
    }


def string(text: str) -> bytes:
    return struct.pack("<H", len(text) + 1) + text.encode() + b"\0"


def write_whisper(folder: Path, arrays: dict[str, np.ndarray], *, version: int = 6) -> Path:
    """Write a file as CTranslate2 does; arrays of uint16 are the upper halves of floats."""
    kinds = {"f4": 0, "i1": 1, "i2": 2, "i4": 3, "f2": 4, "u2": 5}
    content = (
        struct.pack("<I", version) + string("WhisperSpec") + struct.pack("<II", 3, len(arrays))
    )
    for key, array in arrays.items():
        sizes = struct.pack(f"<B{array.ndim}I", array.ndim, *array.shape)
        kind = struct.pack("<BI", kinds[array.dtype.str[1:]], array.nbytes)
        content += string(key) + sizes + kind + array.tobytes()
    content += struct.pack("<I", 0)  # no aliases
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.bin").write_bytes(content)
    return folder
