"""Writes output files, either completely or not at all."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from kouxing.shared.errors import UserError


@contextlib.contextmanager
def open_output(path: Path, *, keep_on_error: bool = False) -> Iterator[BinaryIO]:
    """Open a file for writing.

    If an error or Ctrl-C interrupts the writing, the file is deleted unless ``keep_on_error``.

    Raises ``UserError`` if the file cannot be written.
    """
    try:
        with path.open("wb") as file:
            try:
                yield file
                file.flush()
            except BaseException:
                if path.is_file() and not keep_on_error:  # not a device
                    path.unlink()
                raise
    except OSError as error:
        raise write_error(path, error) from error


def write_private(path: Path, content: bytes) -> None:
    """Write a file that only this user can read. Other processes see it only when it is complete.

    Raises ``OSError`` if the file cannot be written.
    """
    new = path.with_name(f"{path.name}.new")
    try:
        new.unlink(missing_ok=True)
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        new.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            new.unlink()
        raise


def write_error(path: Path, error: Any) -> UserError:
    """Return the error for a file that cannot be written, from an ``OSError`` or FFmpeg's error."""
    if isinstance(error, FileNotFoundError):
        folder = (path.resolve() if path.is_symlink() else path).parent
        return UserError(f"cannot write {path}: the folder does not exist; run: mkdir -p {folder}")
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UserError(f"cannot write {path}: the disk is full; free some space")
    return UserError(f"cannot write {path}: {error.strerror or error}")
