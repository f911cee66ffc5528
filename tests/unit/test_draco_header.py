"""The size of a Draco mesh is known before it is decoded."""

import struct
from typing import Any

import DracoPy
import numpy as np
import pytest

from kouxing.services.driver.head.draco_header import read_mesh_size

NUM_COLUMNS = 20


def encode_grid(**options: Any) -> bytes:
    """Encode two triangles per cell of a square grid."""
    points = np.indices((NUM_COLUMNS, NUM_COLUMNS, 1)).reshape(3, -1).T
    corner = np.arange(NUM_COLUMNS**2).reshape(NUM_COLUMNS, -1)[:-1, :-1].reshape(-1, 1)
    cell = [0, 1, NUM_COLUMNS, 1, NUM_COLUMNS + 1, NUM_COLUMNS]
    faces = (corner + cell).reshape(-1, 3)
    encoded: bytes = DracoPy.encode(
        points.astype(np.float32), faces.astype(np.uint32), quantization_bits=10, **options
    )
    return encoded


@pytest.mark.parametrize("compression_level", [0, 1, 10])
@pytest.mark.parametrize("with_metadata", [False, True])
def test_reads_the_size_of_a_mesh(compression_level: int, with_metadata: bool) -> None:
    data = encode_grid(compression_level=compression_level, create_metadata=with_metadata)
    num_faces, max_points = read_mesh_size(data)
    assert num_faces == 2 * (NUM_COLUMNS - 1) ** 2
    assert NUM_COLUMNS**2 <= max_points <= 3 * num_faces


def test_skips_nested_metadata() -> None:
    start = b"DRACO" + bytes([2, 2, 1, 0, 0, 0x80])
    attribute = b"\x07" + b"\x00" + b"\x00"
    child = b"\x01b" + b"\x01" + b"\x01c\x02\xff\xff" + b"\x00"
    mesh = b"\x00" + b"\x01" + child
    assert read_mesh_size(start + b"\x01" + attribute + mesh + b"\x05\x80\x01") == (5, 128)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"DRACO" + bytes(20),  # another version
        b"DRACO" + bytes([2, 2, 0, 0, 0, 0, 1, 1]),  # a point cloud
        b"DRACO" + bytes([2, 2, 1, 0, 0, 0]),  # cut off
        b"DRACO" + bytes([2, 2, 1, 0, 0, 0]) + b"\xff" * 1000,  # a number without an end
    ],
)
def test_rejects_damaged_headers(data: bytes) -> None:
    with pytest.raises((ValueError, IndexError, struct.error)):
        read_mesh_size(data)
