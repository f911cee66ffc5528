"""Finds the running systems of a user, for commands without an address.

``kouxing run`` writes control's address to a file in the user's own folder, and locks the file. The
lock ends with the process, even if the process is killed.
"""

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from kouxing.shared.errors import UserError


@contextlib.contextmanager
def announce_system(control: str) -> Iterator[None]:
    """Publish control's address to this user's commands while the system runs.

    If the folder cannot be used or written, nothing is announced.
    """
    folder = _own_folder()
    if folder is None:
        yield
        return
    path = folder / str(os.getpid())
    with contextlib.ExitStack() as stack:
        stack.callback(path.unlink, missing_ok=True)
        with contextlib.suppress(OSError):  # such as a full disk
            file = stack.enter_context(path.open("wb", buffering=0))
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(control.encode())
        yield


@contextlib.contextmanager
def lock_startup(on_wait: Callable[[], None]) -> Iterator[None]:
    """Let only one of the user's systems start at a time, so that each detects the others' ports.

    ``on_wait`` is called if another system is starting. If the folder cannot be used, nothing
    waits.
    """
    folder = _own_folder()
    if folder is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            on_wait()
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def lock_output_folder(folder: Path) -> Iterator[None]:
    """Lock the folder of logs and videos while this system runs.

    Raises ``UserError`` if another system uses the folder. An unusable folder is not locked.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UserError(
                    f"{folder}: another kouxing writes its logs and videos to this folder; stop it,"
                    " or choose another folder with --set driver.out=FOLDER"
                ) from None
        yield


def find_control() -> str:
    """Return the address of control in the user's newest running system, or an empty string."""
    folder = _own_folder()
    paths = [] if folder is None else folder.iterdir()
    for path in sorted(paths, key=lambda path: path.stat().st_mtime, reverse=True):
        with contextlib.suppress(FileNotFoundError), path.open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                if control := file.read():
                    return control
                continue
            path.unlink()  # the system has ended
    return ""


def _own_folder() -> Path | None:
    """Return a folder that only this user can write to, or None if there is no such folder."""
    root = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    folder = Path(root) / f"kouxing-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError:
        return None
    is_own = about.st_uid == os.getuid() and about.st_mode & 0o77 == 0
    return folder if is_own else None
