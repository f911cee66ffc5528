"""The log of one service: private, limited in size, and harmless when the disk is full."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import IO

MAX_BYTES = 10_000_000  # of a file; the one before is kept as NAME.log.1
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
        self._file: IO[bytes] | None = None
        self._num_dropped = 0

    def write(self, line: bytes) -> None:
        """Append a line."""
        try:
            self._append(_TOKEN.sub(rb"\1...", line))
        except OSError as error:
            self.close()
            if not self._num_dropped:
                self._warn(f"{self._path}: cannot be written: {error.strerror}")
            self._num_dropped += 1
        else:
            if self._num_dropped:
                self._warn(f"{self._path}: {self._num_dropped} lines were dropped")
            self._num_dropped = 0

    def close(self) -> None:
        """Close the file; a later line opens it again."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None

    def _append(self, line: bytes) -> None:
        if self._file is not None and self._file.tell() > self._max_bytes:
            self.close()
            self._path.replace(self._path.with_name(f"{self._path.name}.1"))
        if self._file is None:
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
            self._file = os.fdopen(os.open(self._path, flags, 0o600), "ab", buffering=0)
            os.fchmod(self._file.fileno(), 0o600)
        self._file.write(line)
