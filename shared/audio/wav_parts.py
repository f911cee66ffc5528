"""Reads WAV files and pipes with several parts: several ``data`` chunks, or joined files.

FFmpeg and ``wave`` read only one part of either.
"""

import math
from typing import BinaryIO, Protocol

from kouxing.shared.audio.audio_formats import MIN_UNKNOWN_BYTES
from kouxing.shared.errors import UserError

_MAX_CHUNK_BYTES = 16 << 20  # limit for pictures and notes between two parts


class Readable(Protocol):
    """A stream of bytes."""

    def read(self, size: int, /) -> bytes:
        """Return up to ``size`` bytes; empty at the end."""
        ...


class WavParts:
    """The bytes of all ``data`` chunks. Reading starts after the header of the first one.

    ``begin`` contains the header of the file, ``num_bytes`` is the size of the first chunk; None:
    until the end. Raises ``UserError`` while reading if a later part has another encoding.
    """

    def __init__(self, stream: Readable, begin: bytes, num_bytes: int | None, name: str) -> None:
        self._stream = stream
        self._name = name
        self._format = begin[begin.find(b"fmt ") + 8 :][:16]
        self._left = self._size = math.inf if num_bytes is None else num_bytes

    @property
    def num_missing(self) -> int:
        """Number of bytes that the last chunk lacks, at the end of the stream."""
        return 0 if math.isinf(self._left) else int(self._left)

    def read(self, size: int, /) -> bytes:
        """Return up to ``size`` bytes of samples; empty at the end."""
        if not self._left and not self._find_part():
            return b""
        piece = self._stream.read(int(min(size, self._left)))
        self._left -= len(piece)
        return piece

    def _find_part(self) -> bool:
        """Skip the chunks until the next part; return whether there is one."""
        self._read_all(int(self._size % 2))  # a chunk has an even number of bytes
        self._size = 0
        while (kind := self._read_all(4)).strip().isalnum():
            size = int.from_bytes(self._read_all(4), "little")
            if kind == b"RIFF":
                self._read_all(4)
            elif kind == b"data":
                self._left = self._size = size if 0 < size < MIN_UNKNOWN_BYTES else math.inf
                return True
            elif size > _MAX_CHUNK_BYTES:
                break
            elif kind == b"fmt " and self._read_all(size)[:16] != self._format:
                raise UserError(
                    f"{self._name}: the encoding of the audio changes; convert each part separately"
                )
            elif kind != b"fmt ":
                self._read_all(size + size % 2)
        return False

    def _read_all(self, size: int) -> bytes:
        content = b""
        while len(content) < size and (piece := self._stream.read(size - len(content))):
            content += piece
        return content


def count_parts(file: BinaryIO) -> int:
    """Return the number of audio parts, or 0 if this is not a WAV file; rewind the file."""
    count = offset = file.seek(0)
    while (kind := file.read(4)).strip().isalnum():
        size = int.from_bytes(file.read(4), "little")
        if kind == b"RIFF" and file.read(4) == b"WAVE":
            size = 4
        elif offset == 0:
            break
        count += kind == b"data" and size > 0
        offset += 8 + size + size % 2
        file.seek(offset)
    file.seek(0)
    return count
