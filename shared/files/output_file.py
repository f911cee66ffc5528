"""Writes output files, either completely or not at all."""

import contextlib
import errno
import fcntl
import os
import re
import secrets
import shlex
import shutil
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from kouxing.shared.errors import UserError

MAX_NAME = 40  # characters of the output's name in the name of its unfinished file


class UnfinishedFile:
    """A new file next to an output, locked by this process until it is deleted or renamed.

    If this process is killed, the file stays until ``remove_unfinished``. Raises ``OSError`` if the
    file cannot be created.
    """

    def __init__(self, output: Path) -> None:
        while True:
            # another process may be writing the same output
            name = f".{output.name[:MAX_NAME]}.{secrets.token_hex(4)}.part"
            self.path = output.with_name(name)
            locks: list[BinaryIO] = []
            # first, because Ctrl-C may interrupt any of the following lines
            self.delete = weakref.finalize(self, _delete, self.path, locks)
            locks.append(self.path.open("xb"))
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(locks[0], fcntl.LOCK_EX)
            if os.fstat(locks[0].fileno()).st_nlink:
                return
            self.delete()  # another process deleted it before it was locked


def remove_unfinished(folder: Path, output_name: str = "") -> None:
    """Delete the unfinished files of killed processes, of one output or of all in a folder."""
    for path in folder.glob(".*.part"):
        match = re.fullmatch(r"\.(.+)\.[0-9a-f]{8}\.part", path.name)
        if match is None or output_name[:MAX_NAME] not in ("", match[1]):
            continue
        with contextlib.suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails while a process writes it
            path.unlink()


def _delete(path: Path, locks: list[BinaryIO]) -> None:
    path.unlink(missing_ok=True)
    for lock in locks:
        lock.close()


@contextlib.contextmanager
def open_output(
    path: Path, *, keep_on_error: bool = False, removes_unfinished: bool = True
) -> Iterator[BinaryIO]:
    """Open a file for writing. Once it is complete, it gets its name, and replaces an older file.

    If an error or Ctrl-C interrupts the writing, an older file stays as it was. Links, devices and
    pipes are written directly. With ``keep_on_error``, files are also written directly, and keep
    what was written before an error. With ``removes_unfinished``, the files that killed processes
    have left for this output are deleted first.

    Raises ``UserError`` if the file cannot be written.
    """
    try:
        if keep_on_error or not _can_replace(path):
            with path.open("wb") as file:
                yield file
            return
        if removes_unfinished:
            remove_unfinished(path.parent, path.name)
        unfinished = UnfinishedFile(path)
        try:
            with unfinished.path.open("wb") as file:
                yield file
            _replace(path, unfinished.path)
        finally:
            unfinished.delete()
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


def create_folder(path: Path) -> None:
    """Create a folder and its parents, unless it exists; raise ``UserError`` if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(path, error) from None


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


def path_as_text(path: Path | str) -> str:
    """Return a path, or a text with paths, as valid UTF-8. Other bytes are replaced."""
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def write_error(path: Path, error: Any) -> UserError:
    """Return the error for a file that cannot be written, from an ``OSError`` or FFmpeg's error."""
    if isinstance(error, FileNotFoundError):
        folder = (path.resolve() if path.is_symlink() else path).parent
        command = f"mkdir -p {shlex.quote(str(folder))}"
        return UserError(f"cannot write {path}: the folder does not exist; run: {command}")
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UserError(f"cannot write {path}: the disk is full; free some space")
    if error.errno == errno.EFBIG:
        return UserError(
            f"cannot write {path}: the file is larger than 'ulimit -f' or the file system allows;"
            " raise the limit, or choose another disk"
        )
    if isinstance(error, FileExistsError | NotADirectoryError):
        file = next(parent for parent in (path, *path.parents) if parent.exists())
        return UserError(f"cannot write {path}: {file} is not a folder; choose another folder")
    remedy = "; choose another folder" if isinstance(error, PermissionError) else ""
    return UserError(f"cannot write {path}: {error.strerror or error}{remedy}")
