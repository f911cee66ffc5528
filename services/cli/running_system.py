"""Where a user's systems run, for commands that are told no address.

``kouxing run`` writes control's address to a file in a folder of the user's own, and holds a lock
on the file for as long as it runs. The lock goes with the process, however that ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def announce(control: str) -> Iterator[None]:
    """Let commands of this user find a system while it runs.

    A machine on which that is impossible runs it all the same.
    """
    folder = _folder()
    if folder is None:
        yield
        return
    path = folder / str(os.getpid())
    with path.open("w", encoding="utf-8") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write(control)
        file.flush()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def find_control() -> str:
    """Return where control of the user's newest running system takes commands; "": none runs."""
    folder = _folder()
    paths = [] if folder is None else folder.iterdir()
    for path in sorted(paths, key=lambda path: path.stat().st_mtime, reverse=True):
        with contextlib.suppress(FileNotFoundError), path.open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return file.read()
            path.unlink()  # its system is gone
    return ""


def _folder() -> Path | None:
    """Return a folder that only this user can write to, or None."""
    root = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    folder = Path(root) / f"kouxing-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError:
        return None
    is_own = about.st_uid == os.getuid() and about.st_mode & 0o77 == 0
    return folder if is_own else None
