"""The size of a Draco mesh is known before it is decoded, and its memory is limited."""

import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np
import pytest

from kouxing.services.driver.head.draco_decoder import read_mesh_size

NUM_COLUMNS = 20
DECODE = """\
import resource, sys
from kouxing.services.driver.head import draco_decoder
draco_decoder._DECODER_BYTES = 1 << 20
limits = resource.getrlimit(resource.RLIMIT_AS)
try:
    mesh = draco_decoder.decode_mesh(open(sys.argv[1], "rb").read(), 2 * int(sys.argv[2]))
    print(len(mesh.points))
except MemoryError:
    print("too large")
if resource.getrlimit(resource.RLIMIT_AS) == limits:
    print("same limits")
"""  # a new process, because free memory of this one is not limited


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


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux limits the memory")
def test_limits_the_memory_of_attributes_that_are_not_listed(tmp_path: Path) -> None:
    points = np.zeros((199_998, 3), np.float32)
    points[:, 0] = np.arange(len(points))
    faces = np.arange(len(points), dtype=np.uint32).reshape(-1, 3)
    others = {f"other{i}": np.zeros((len(points), 4), np.uint32) for i in range(30)}
    few: bytes = DracoPy.encode(points, faces)
    many: bytes = DracoPy.encode(points, faces, generic_attributes=others)
    assert len(many) < len(few) + 2000
    outputs = []
    for data in (few, many):
        (tmp_path / "mesh.drc").write_bytes(data)
        command = [sys.executable, "-c", DECODE, str(tmp_path / "mesh.drc"), str(points.nbytes)]
        outputs.append(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert outputs == [f"{len(points)}\nsame limits\n", "too large\nsame limits\n"]


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
