"""Reads users' files: only regular files, up to a size limit, with clear errors.

A FIFO blocks its reader, and a device may never end. Such files are rejected by their status before
they are opened. A growing file is read up to its size at the start.
"""

import contextlib
import io
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from kouxing.shared.errors import UserError

_MAX_LINE = 1_000_000
_MAX_JSON_VALUES = 2_000_000  # a value needs up to 150 bytes of memory


def open_file(path: Path, max_bytes: int, *, pipe: bool = False) -> BinaryIO:
    """Open a regular file for reading; also a FIFO if ``pipe`` is set.

    Raises ``UserError`` if it is another kind of file, cannot be opened, or is too large.
    """
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise UserError(f"{path}: this is a folder; expected a file")
        if not (stat.S_ISREG(status.st_mode) or (pipe and stat.S_ISFIFO(status.st_mode))):
            raise UserError(f"{path}: this is a pipe or device; expected a regular file")
        if status.st_size > max_bytes:
            limit = f"{max_bytes >> 20} MiB" if max_bytes >> 20 else f"{max_bytes >> 10} KiB"
            raise UserError(f"{path}: the file is larger than {limit}; split or reduce it")
        return path.open("rb")
    except FileNotFoundError:
        if str(path).startswith(("http:/", "https:/")):  # a Path has one slash
            address = str(path).replace(":/", "://", 1)
            raise UserError(f"{address}: this is a URL; download the file first") from None
        raise UserError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: invalid file name
        raise _unreadable(path, error) from None


def read_file(path: Path, max_bytes: int) -> bytes:
    """Return the bytes of a regular file; raises as ``open_file``."""
    with open_file(path, max_bytes) as file:
        try:
            return file.read(os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise _unreadable(path, error) from None


def read_text(path: Path, max_bytes: int) -> str:
    """Return the text of a UTF-8 file without its byte order mark; raises as ``open_file``."""
    try:
        return read_file(path, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(f"{path}: this is not UTF-8 text; convert it") from None


def split_lines(path: Path, text: str) -> Iterator[str]:
    """Yield the lines of a file's text.

    Raises ``UserError`` if a line is too long to split into columns.
    """
    for number, line in enumerate(io.StringIO(text, None), start=1):
        if len(line) > _MAX_LINE:
            raise UserError(f"{path}: line {number} has more than {_MAX_LINE} characters; cut it")
        yield line


def parse_json(text: str | bytes, *, allow_nan: bool = False) -> Any:
    """Parse JSON from an untrusted source.

    Raises ``ValueError`` if it is not valid, is nested too deeply, or has too many values. NaN and
    infinity are not valid unless ``allow_nan`` is set.
    """
    marks = (b",", b"[", b"{") if isinstance(text, bytes) else (",", "[", "{")
    if sum(map(text.count, marks)) > _MAX_JSON_VALUES:  # type: ignore[arg-type]
        raise ValueError(f"it has more than {_MAX_JSON_VALUES} values")
    try:
        return json.loads(text, parse_constant=None if allow_nan else _reject_constant)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _reject_constant(word: str) -> float:
    raise ValueError(f"{word} is not valid JSON")


@contextlib.contextmanager
def check_content(path: Path, expected: str) -> Iterator[None]:
    """Raise ``UserError`` for every error of the enclosed parser, of any class.

    ``expected`` describes a valid file; it may add a remedy.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, KeyError):
            reason = f"it lacks {reason}"
        raise UserError(f"{path}: the file is damaged or is not {expected} ({reason})") from error


def _unreadable(path: Path, error: Exception) -> UserError:
    return UserError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}")
