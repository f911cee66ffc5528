"""Decodes Draco meshes from untrusted files (Draco Bitstream Specification 2.2).

DracoPy cannot limit the size of a decoded mesh, and a few bytes can describe millions of faces or
thousands of attributes. The header contains only the number of faces.
"""

import contextlib
import io
import resource
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_MEMORY_USE = Path("/proc/self/statm")  # only Linux has it
_DECODER_BYTES = 256 << 20  # memory that a decoder may need for a small mesh
_COPIES = 4  # a decoder needs up to this many times the size of the decoded mesh
_HAS_METADATA = 0x8000  # flag
_SEQUENTIAL = 0  # encoding whose header contains the number of points


def decode_mesh(data: bytes, num_bytes: int) -> Any:
    """Return DracoPy's mesh, which is expected to have ``num_bytes``.

    Raises ``MemoryError`` if the mesh needs much more memory, for example for attributes that the
    file does not list. Systems other than Linux have no such limit.
    """
    import DracoPy  # noqa: PLC0415 - few files need it

    with _limited_memory(_DECODER_BYTES + _COPIES * num_bytes):
        return DracoPy.decode(data)


@contextlib.contextmanager
def _limited_memory(num_bytes: int) -> Iterator[None]:
    """Limit the memory that all threads of this process can allocate in the enclosed code."""
    if not _MEMORY_USE.exists():
        yield
        return
    used_bytes = int(_MEMORY_USE.read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limits = (used_bytes + num_bytes, *(limit for limit in (soft, hard) if limit >= 0))
    resource.setrlimit(resource.RLIMIT_AS, (min(limits), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def read_mesh_size(data: bytes) -> tuple[int, int]:
    """Return the number of faces of a Draco mesh, and the largest possible number of its points.

    Raises ``ValueError``, ``IndexError`` or ``struct.error`` if the data is not such a mesh.
    """
    stream = io.BytesIO(data)
    *version, encoding, flags = struct.unpack("<5s4BH", stream.read(11))
    if version != [b"DRACO", 2, 2, 1]:
        raise ValueError("the compressed data is not a Draco mesh of version 2.2")
    if flags & _HAS_METADATA:
        for _ in range(_read_number(stream)):
            _read_number(stream)  # the attribute
            _skip_metadata(stream)
        _skip_metadata(stream)  # of the mesh
    if encoding == _SEQUENTIAL:
        return _read_number(stream), _read_number(stream)
    stream.read(1)  # Edgebreaker: the kind of traversal
    _read_number(stream)  # number of vertices; the decoder may split one into several points
    num_faces = _read_number(stream)
    return num_faces, 3 * num_faces


def _read_number(stream: io.BytesIO) -> int:
    """Read an unsigned LEB128 number."""
    number = 0
    for shift in range(0, 70, 7):
        byte = stream.read(1)[0]
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number
    raise ValueError("a number in the Draco header is too long")


def _skip_metadata(stream: io.BytesIO) -> None:
    for _ in range(_read_number(stream)):
        stream.read(stream.read(1)[0])  # name
        stream.read(_read_number(stream))  # value
    for _ in range(_read_number(stream)):
        stream.read(stream.read(1)[0])
        _skip_metadata(stream)
