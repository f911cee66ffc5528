"""Reads npz files of plain arrays. Their unpacked size is checked before they are unpacked."""

from __future__ import annotations

import stat
import zipfile
import zlib
from math import prod
from pathlib import Path
from typing import Any

from numpy.lib import format as npy
from numpy.typing import NDArray

MAX_ARRAYS = 1000
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others need much memory
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_arrays(path: Path, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Read all arrays of an npz file, never a pickle.

    Raises ``OSError`` if the file cannot be read. Raises ``ValueError`` if it is not an npz file of
    plain arrays, or has more than ``max_bytes``.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("it is not a file")
    if status.st_size > max_bytes:
        raise ValueError(f"it is larger than {max_bytes // 2**20} MiB")
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > max_bytes:
                raise ValueError(f"it is larger than {max_bytes // 2**20} MiB unpacked")
            if len(entries) > MAX_ARRAYS:
                raise ValueError(f"it has {len(entries)} arrays")
            return {
                entry.filename.removesuffix(".npy"): _read_array(archive, entry)
                for entry in entries
            }
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(str(error)) from error


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """Read one array, if its header asks for no more memory than the file has bytes."""
    if entry.compress_type not in _METHODS:
        raise ValueError(f"{entry.filename} uses an unsupported compression")
    with archive.open(entry) as stream:
        version = npy.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"{entry.filename} is an array of unknown version {version}")
        shape, _, kind = _HEADERS[version](stream)
        if stream.tell() + prod(shape) * kind.itemsize > entry.file_size:
            raise ValueError(f"{entry.filename} is cut off")
    with archive.open(entry) as stream:
        array: NDArray[Any] = npy.read_array(stream, allow_pickle=False)
        return array
