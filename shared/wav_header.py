"""The header of a WAV stream, whose end need not be known."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from kouxing.shared.errors import UserError

_CHUNK = struct.Struct("<4sI")
_FORMAT = struct.Struct("<HHI6xH")  # tag, channels, Hz, bits
_TAG = struct.Struct("<H")
_EXTENSIBLE, _TAG_PLACE = 0xFFFE, 24  # the tag is later in the chunk
_ENCODINGS = {(1, 16): "s16le", (3, 32): "f32le"}  # by tag and bits


@dataclass(frozen=True, slots=True)
class WavHeader:
    """The format that a WAV header states."""

    sample_rate_hz: int
    num_channels: int
    encoding: str  # s16le or f32le
    num_bytes: int  # of the header, before the samples


def read_wav_header(begin: bytes) -> WavHeader | None:
    """Return the header at the start of a stream, or None if it is not a WAV stream.

    Raises
    ------
    UserError
        If the encoding is not supported, or the header is incomplete.
    """
    if begin[:4] != b"RIFF" or begin[8:12] != b"WAVE":
        return None
    stated: tuple[int, int, int, int] | None = None
    place = 12
    while place + _CHUNK.size <= len(begin):
        name, size = _CHUNK.unpack_from(begin, place)
        place += _CHUNK.size
        if name == b"fmt " and place + _FORMAT.size <= len(begin):
            stated = _FORMAT.unpack_from(begin, place)
            if stated[0] == _EXTENSIBLE and place + _TAG_PLACE + _TAG.size <= len(begin):
                stated = (*_TAG.unpack_from(begin, place + _TAG_PLACE), *stated[1:])
        elif name == b"data" and stated is not None:
            tag, num_channels, rate_hz, bits = stated
            encoding = _ENCODINGS.get((tag, bits))
            if encoding is None:
                raise UserError(
                    f"the WAV header states format {tag} with {bits} bits; use 16-bit PCM or "
                    "32-bit float"
                )
            return WavHeader(rate_hz, num_channels, encoding, num_bytes=place)
        place += size + size % 2
    raise UserError("the WAV header is incomplete; send all of it at once")
