"""npz files that are damaged or too large are rejected before anything is unpacked."""

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.files.array_file import read_arrays

MIB = 1024 * 1024


def npy(array: np.ndarray, **header: object) -> bytes:
    """Return the bytes of an array; ``header`` replaces fields of its header."""
    stream = io.BytesIO()
    if header:
        description = {"descr": "<f4", "fortran_order": False, "shape": array.shape, **header}
        np.lib.format.write_array_header_1_0(stream, description)
        stream.write(array.tobytes())
    else:
        np.save(stream, array)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "method"),
    [
        (npy(np.zeros(4, "<f4"), shape=(2**40,)), zipfile.ZIP_DEFLATED),
        (npy(np.zeros(4, "<f4"), shape=(-(2**40),)), zipfile.ZIP_DEFLATED),
        (npy(np.zeros(4, "<f4")), zipfile.ZIP_LZMA),
        (b"\x93NUMPY\x09\x09", zipfile.ZIP_DEFLATED),
        (b"no array", zipfile.ZIP_DEFLATED),
        (npy(np.zeros(4)).replace(b"}", b" "), zipfile.ZIP_DEFLATED),
        (npy(np.zeros(0, "S1"), shape=(2**40,), descr="|S0"), zipfile.ZIP_DEFLATED),
        (npy(np.zeros(4 * MIB)), zipfile.ZIP_DEFLATED),
    ],
)
def test_rejects_a_damaged_or_huge_array_before_unpacking_it(
    tmp_path: Path, content: bytes, method: int
) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr("format.npy", content)
    tracemalloc.start()
    with pytest.raises(UserError, match="not a model"):
        read_arrays(tmp_path / "a.npz", 2 * MIB, "a model")
    assert tracemalloc.get_traced_memory()[1] < MIB
    tracemalloc.stop()
