"""npz files: valid files are read; others are rejected before anything is unpacked."""

from __future__ import annotations

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.driver.head.head import Head
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.shared.array_file import read_arrays
from kouxing.shared.errors import UserError

pytestmark = pytest.mark.unit

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


def test_arrays_round_trip(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6).reshape(2, 3), "b": np.array("text"), "c": np.zeros((0, 4))}
    np.savez_compressed(tmp_path / "a.npz", allow_pickle=False, **arrays)
    again = read_arrays(tmp_path / "a.npz", MIB)
    assert again.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(again[name], array)


def peak_bytes_of(path: Path, load: object) -> int:
    tracemalloc.start()
    try:
        with pytest.raises(UserError):
            load(path)  # type: ignore[operator]
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("load", [load_model, Head.load])
def test_rejects_a_zip_bomb_before_unpacking_it(tmp_path: Path, load: object) -> None:
    with zipfile.ZipFile(
        tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1
    ) as archive:
        for number in range(20):
            with archive.open(f"{number}.npy", "w") as entry:
                entry.write(npy(np.zeros(0, "<f4"), shape=(8 * MIB,)))
                entry.write(bytes(32 * MIB))
    assert peak_bytes_of(tmp_path / "bomb.npz", load) < MIB


@pytest.mark.parametrize(
    ("content", "method"),
    [
        (npy(np.zeros(4, "<f4"), shape=(2**40,)), zipfile.ZIP_DEFLATED),
        (npy(np.zeros(4, "<f4"), shape=(-(2**40),)), zipfile.ZIP_DEFLATED),
        (npy(np.zeros(4, "<f4")), zipfile.ZIP_LZMA),
        (b"\x93NUMPY\x09\x09", zipfile.ZIP_DEFLATED),
        (b"no array", zipfile.ZIP_DEFLATED),
    ],
)
def test_rejects_a_damaged_array(tmp_path: Path, content: bytes, method: int) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr("format.npy", content)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r".+"):
        read_arrays(tmp_path / "a.npz", MIB)
    assert tracemalloc.get_traced_memory()[1] < MIB
    tracemalloc.stop()


def test_rejects_a_device() -> None:
    with pytest.raises(ValueError, match="not a file"):
        read_arrays(Path("/dev/zero"), MIB)
