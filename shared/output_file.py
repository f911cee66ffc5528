"""Writes output files, either completely or not at all."""

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from kouxing.shared.errors import UserError


@contextlib.contextmanager
def open_output(path: Path, *, keep_on_error: bool = False) -> Iterator[BinaryIO]:
    """Open a file for writing. Once it is complete, it gets its name, and replaces an older file.

    If an error or Ctrl-C interrupts the writing, an older file stays as it was. Links, devices and
    pipes are written directly. With ``keep_on_error``, files are also written directly, and keep
    what was written before an error.

    Raises ``UserError`` if the file cannot be written.
    """
    try:
        if keep_on_error or not _can_replace(path):
            with path.open("wb") as file:
                yield file
            return
        part = path.with_name(f".{path.name[:40]}.{secrets.token_hex(4)}.part")
        try:
            with part.open("wb") as file:
                yield file
            _replace(path, part)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from error


def _can_replace(path: Path) -> bool:
    if path.is_symlink() or (path.exists() and not path.is_file()):
        return False
    return os.access(path.parent, os.W_OK) and (not path.exists() or os.access(path, os.W_OK))


def _replace(path: Path, part: Path) -> None:
    """Give a complete file its name. It keeps the permissions of an older file."""
    if path.exists():
        shutil.copymode(path, part)
    try:
        part.replace(path)
    except OSError:  # a mount point, or another user's file in a shared folder
        shutil.copyfile(part, path)


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
