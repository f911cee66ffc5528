"""Reads npz files of plain arrays, after a check of their unpacked size."""

import io
import zipfile
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

from numpy.lib import format as npy
from numpy.typing import NDArray

from kouxing.shared.files.user_file import check_content, open_file

MAX_ARRAYS = 1000
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # other methods need much memory
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_ENTRY = b"PK\1\2"  # signature in the table at the end of an archive


def read_arrays(path: Path, max_bytes: int, expected: str) -> dict[str, NDArray[Any]]:
    """Read all arrays of an npz file, never a pickle.

    Raises ``UserError`` if the file cannot be read, is not an npz file of plain arrays, or has more
    than ``max_bytes``. The error says that the file is not ``expected``.
    """
    with open_file(path, max_bytes) as file, check_content(path, expected):
        # ZipFile reads the whole table, so its entries are counted first
        pieces = iter(partial(file.read, 1 << 18), b"")
        if sum(piece.count(_ENTRY) for piece in pieces) > MAX_ARRAYS:
            raise ValueError(f"it has more than {MAX_ARRAYS} arrays")
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > max_bytes:
                raise ValueError(f"it is larger than {max_bytes >> 20} MiB unpacked")
            return {
                entry.filename.removesuffix(".npy"): _read_array(archive, entry)
                for entry in entries
            }


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """Read one array, unless its header states more bytes than the file has."""
    if entry.compress_type not in _METHODS:
        raise ValueError(f"{entry.filename} uses an unsupported compression")
    with archive.open(entry) as stream:
        version = npy.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"{entry.filename} is an array of unknown version {version}")
        shape, _, kind = _HEADERS[version](stream)
        if stream.tell() + prod(shape) * max(1, kind.itemsize) > entry.file_size:
            raise ValueError(f"{entry.filename} is cut off")
    with archive.open(entry) as stream:
        content = io.BytesIO(stream.read(entry.file_size))  # one call lets other threads run
        return npy.read_array(content, allow_pickle=False)
