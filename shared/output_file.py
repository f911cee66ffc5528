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
        with contextlib.ExitStack() as stack:
            is_direct = keep_on_error or not _can_replace(path)
            written = path if is_direct else path.with_name(f".{secrets.token_hex(8)}.part")
            if not is_direct:
                stack.callback(written.unlink, missing_ok=True)
            with written.open("wb") as file:
                yield file
            if not is_direct:
                if path.exists():
                    shutil.copymode(path, written)
                written.replace(path)
    except OSError as error:
        raise write_error(path, error) from error


def _can_replace(path: Path) -> bool:
    is_special = path.is_symlink() or (path.exists() and not path.is_file())
    return not is_special and os.access(path.parent, os.W_OK)


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
