"""The log file of one service: private, limited in size, and harmless when the disk is full.

``RotatingFileHandler`` of ``logging`` is not used: it follows symbolic links, and leaves incomplete
lines on a full disk.
"""

import contextlib
import errno
import os
import re
from collections.abc import Callable
from pathlib import Path

from kouxing.shared.files.output_file import write_error

MAX_BYTES = 10_000_000  # per file; the previous file is kept as NAME.log.1
_TOKEN = re.compile(rb"(token=)[^\s\"'&]+")


class LogFile:
    """Appends lines to a file that only this user can read, without the page's token.

    Writing never raises. Lines that cannot be written are counted; ``warn`` reports the first one
    and, when lines can be written again, the number.
    """

    def __init__(
        self, path: Path, warn: Callable[[str], None], *, max_bytes: int = MAX_BYTES
    ) -> None:
        self._path = path
        self._warn = warn
        self._max_bytes = max_bytes
        self._descriptor: int | None = None
        self._num_dropped = 0

    def check(self) -> None:
        """Create the file. Raises ``OSError`` if it cannot be written."""
        self._open()
        self.close()

    def write(self, line: bytes) -> None:
        """Append a line."""
        try:
            self._append(_TOKEN.sub(rb"\1...", line))
        except OSError as error:
            self.close()
            if not self._num_dropped:
                self._warn(str(write_error(self._path, error)))
            self._num_dropped += 1
        else:
            if self._num_dropped:
                self._warn(f"{self._path}: {self._num_dropped} lines were dropped")
            self._num_dropped = 0

    def close(self) -> None:
        """Close the file; a later line opens it again."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = None

    def _append(self, line: bytes) -> None:
        descriptor = self._open()
        if os.fstat(descriptor).st_size > self._max_bytes:
            self.close()
            self._path.replace(self._path.with_name(f"{self._path.name}.1"))
            descriptor = self._open()
        size = os.fstat(descriptor).st_size
        if os.write(descriptor, line) < len(line):
            os.ftruncate(descriptor, size)  # remove the incomplete line
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _open(self) -> int:
        """Return the file's descriptor; recreate the file if it was deleted."""
        if self._descriptor is not None and os.fstat(self._descriptor).st_nlink:
            return self._descriptor
        self.close()
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        is_regular = self._path.is_file() and not self._path.is_symlink()
        if os.path.lexists(self._path) and not is_regular:
            raise OSError(errno.EINVAL, "it is not a regular file; delete it")
        self._descriptor = os.open(self._path, flags, 0o600)
        os.fchmod(self._descriptor, 0o600)
        return self._descriptor
