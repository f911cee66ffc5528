"""Converts audio to PCM as it is sent."""

from __future__ import annotations

import sys
from array import array
from collections.abc import Iterable, Iterator
from typing import Any

SAMPLE_BYTES = {"s16le": 2, "f32le": 4}
_CODES = {"s16le": "h", "f32le": "f"}
_FULL_SCALE = 32767


def to_pcm(audio: Any, encoding: str) -> bytes:
    """Convert audio to interleaved PCM.

    Parameters
    ----------
    audio
        Bytes of PCM in the encoding, or numbers (16-bit integers, or floats within ±1) in an
        iterable or a buffer, of shape ``(n,)`` or ``(n, channels)``.
    encoding
        ``s16le`` or ``f32le``.
    """
    try:
        view = memoryview(audio)
    except TypeError:
        return _pack(array("d", audio), encoding)
    flat = memoryview(view.tobytes())  # of any number of dimensions
    if view.format in ("B", "b", "c"):
        return flat.tobytes()
    return _pack(flat.cast(view.format), encoding)  # type: ignore[call-overload]


def _pack(numbers: memoryview[Any] | array[float], encoding: str) -> bytes:
    is_integer = isinstance(numbers, memoryview) and numbers.format == "h"
    scaled: Iterable[float] = numbers
    if encoding == "s16le" and not is_integer:
        scaled = (round(_FULL_SCALE * max(-1.0, min(1.0, value))) for value in numbers)
    elif encoding == "f32le" and is_integer:
        scaled = (value / _FULL_SCALE for value in numbers)
    packed = array(_CODES[encoding], scaled)
    if sys.byteorder == "big":
        packed.byteswap()
    return packed.tobytes()


def split(pcm: bytes, num_bytes: int) -> Iterator[bytes]:
    """Split PCM into pieces of at most ``num_bytes``."""
    for begin in range(0, len(pcm), num_bytes):
        yield pcm[begin : begin + num_bytes]
