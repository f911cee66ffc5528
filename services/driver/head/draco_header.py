"""Reads the size of a Draco mesh before it is decoded (Draco Bitstream Specification 2.2).

DracoPy cannot limit the size of a decoded mesh, and a few bytes can describe millions of faces.
The header does not contain the number of attributes, and only a decoder can find their headers.
"""

import io
import struct

_HAS_METADATA = 0x8000  # flag
_SEQUENTIAL = 0  # encoding whose header contains the number of points


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
