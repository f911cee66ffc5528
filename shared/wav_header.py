"""The header of a WAV file that comes as a stream, so that its end need not be known."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from kouxing.shared.errors import UserError

_CHUNK = struct.Struct("<4sI")
_FORMAT = struct.Struct("<HHI6xH")  # tag, channels, Hz, bits
_TAG = struct.Struct("<H")
_EXTENSIBLE, _TAG_PLACE = 0xFFFE, 24  # the tag stands further on in the chunk
_ENCODINGS = {(1, 16): "s16le", (3, 32): "f32le"}  # by tag and bits


@dataclass(frozen=True, slots=True, kw_only=True)
class WavHeader:
    """What a WAV header states."""

    sample_rate_hz: int
    num_channels: int
    encoding: str  # s16le or f32le
    num_bytes: int  # of the header: samples follow


def read_wav_header(begin: bytes) -> WavHeader | None:
    """Return the header with which a stream begins; None if there is none.

    Raises
    ------
    UserError
        If the samples are in none of the encodings, or not all of the header is there.
    """
    if begin[:4] != b"RIFF" or begin[8:12] != b"WAVE":
        return None
    found: tuple[int, int, int, int] | None = None
    place = 12
    while place + _CHUNK.size <= len(begin):
        name, size = _CHUNK.unpack_from(begin, place)
        place += _CHUNK.size
        if name == b"fmt " and place + _FORMAT.size <= len(begin):
            found = _FORMAT.unpack_from(begin, place)
            if found[0] == _EXTENSIBLE and place + _TAG_PLACE + _TAG.size <= len(begin):
                found = (*_TAG.unpack_from(begin, place + _TAG_PLACE), *found[1:])
        elif name == b"data" and found is not None:
            tag, num_channels, rate_hz, bits = found
            encoding = _ENCODINGS.get((tag, bits))
            if encoding is None:
                raise UserError(
                    f"the WAV header says format {tag} with {bits} bits; expected PCM of 16 bits, "
                    "or float of 32"
                )
            return WavHeader(
                sample_rate_hz=rate_hz,
                num_channels=num_channels,
                encoding=encoding,
                num_bytes=place,
            )
        place += size + size % 2
    raise UserError("the WAV header is cut off: all of it must come at once")
