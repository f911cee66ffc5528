"""Conversion of PCM audio to floats in [-1, 1] and back."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.arrays import Floats, Int16
from kouxing.shared.errors import UserError

FULL_SCALE = 32768.0  # divides 16-bit samples, which are then in [-1, 1)


def as_floats(samples: NDArray[Any]) -> Floats:
    """Convert samples of any type to floats with full scale at 1."""
    values = samples.astype(np.float32)
    if samples.dtype.kind == "f":
        return values
    values *= np.float32(2.0 ** (1 - 8 * samples.dtype.itemsize))
    return values - 1 if samples.dtype.kind == "u" else values


def as_integers(samples: Floats) -> Int16:
    """Convert samples in [-1, 1] to little-endian 16-bit integers."""
    scaled = np.clip(np.rint(samples * FULL_SCALE), -FULL_SCALE, FULL_SCALE - 1)
    integers: Int16 = scaled.astype("<i2")
    return integers


def decode_pcm(pcm: bytes, encoding: str, num_channels: int) -> Floats:
    """Convert bytes to samples, shape (n, channels), clipped to [-1, 1].

    ``encoding`` is ``s16le`` or ``f32le``.

    Raises ``UserError`` if the bytes are not a whole number of sample frames, or a sample is not
    finite.
    """
    is_16_bit = encoding == "s16le"
    frame_bytes = (2 if is_16_bit else 4) * num_channels
    if len(pcm) % frame_bytes:
        raise UserError(
            f"{len(pcm)} bytes are not a multiple of {frame_bytes} bytes ({encoding}, channels: "
            f"{num_channels}); send the encoding and channels that the session was opened with"
        )
    if is_16_bit:
        return as_floats(np.frombuffer(pcm, "<i2")).reshape(-1, num_channels)
    samples = np.frombuffer(pcm, "<f4").astype(np.float32)
    if not np.isfinite(samples).all():
        raise UserError("the chunk was dropped: it contains NaN or infinite samples")
    return np.clip(samples, -1.0, 1.0).reshape(-1, num_channels)
