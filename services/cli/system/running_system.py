"""Finds the running systems of a user, for commands without an address.

``kouxing run`` writes control's address and the folder of its keys to a file in the user's own
folder, and locks the file. The lock ends with the process, even if the process is killed.

One user can have systems with different keys, such as in a container or with another
``XDG_STATE_HOME``. Commands use only a system with their keys.
"""

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from kouxing.services.service_kinds import read_settings
from kouxing.shared.errors import UserError
from kouxing.shared.settings.config import ServiceConfig
from kouxing.shared.settings.endpoints import split_endpoint
from kouxing.shared.settings.keys import control_endpoint, key_folder


class RunningSystem(NamedTuple):
    """A system of this user."""

    control: str  # control's address and, with encryption, its public key
    keys: str  # folder of its keys

    @property
    def address(self) -> str:
        """Address of control."""
        return self.control.partition(" ")[0]


@dataclass(frozen=True, slots=True)
class ChosenSystem:
    """The system that a command connects to."""

    config: ServiceConfig
    running_endpoint: str  # control's endpoint in the user's newest system; empty if none was found
    uses_default_address: bool  # no address is given, and no running system was found


@contextlib.contextmanager
def announce_system(control: str) -> Iterator[None]:
    """Publish control's address to this user's commands while the system runs.

    If the folder cannot be used or written, nothing is announced.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # such as a full disk
            path = _own_folder() / str(os.getpid())
            stack.callback(path.unlink, missing_ok=True)
            file = stack.enter_context(path.open("wb", buffering=0))
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(os.fsencode(f"{control}\n{_key_folder()}"))
        yield


@contextlib.contextmanager
def lock_startup(on_wait: Callable[[], None]) -> Iterator[None]:
    """Let only one of the user's systems start at a time, so that each detects the others' ports.

    ``on_wait`` is called if another system is starting. If the folder cannot be used, nothing
    waits.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            descriptor = os.open(_own_folder(), os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                on_wait()
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


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


@contextlib.contextmanager
def open_control_address(address: str) -> Iterator[str]:
    """Yield the address of control, followed by its public key unless connections are insecure.

    Without ``address`` and a setting, it is the address of the newest system with this user's keys.
    Raises ``UserError`` if there is no such system, and control's default address cannot be used.
    """
    from kouxing_client import NotConnected
    from kouxing_client.connection_check import NO_LISTENER

    system = choose_system(address)
    config = system.config
    others = other_systems() if system.uses_default_address else []
    if any(other.address == config.control for other in others):
        raise UserError(_not_running_text(others))
    try:
        yield system.running_endpoint or control_endpoint(config.control, insecure=config.insecure)
    except UserError as error:
        if system.uses_default_address and isinstance(error.__cause__, NotConnected):
            tried = config.control if NO_LISTENER in str(error) else error  # one remedy is enough
            raise UserError(f"{_not_running_text(others)}. Tried: {tried}") from error
        raise


def choose_system(address: str) -> ChosenSystem:
    """Choose the system whose control is ``address``, is in the settings, or was started last."""
    if address:
        split_endpoint(address, "--control")
    settings = read_settings(assignments={"common.control": address} if address else {})
    keys = {setting.key: setting for setting in settings.describe(ServiceConfig)}
    is_given = not keys["control"].is_default
    running = "" if is_given else newest_control_endpoint()
    config = settings.load(ServiceConfig)
    if "*" in config.control:
        key = "--control" if address else "common.control"
        raise UserError(f"{key}: {config.control!r} is not a host and port; write tcp://HOST:PORT")
    return ChosenSystem(config, running, uses_default_address=not (running or is_given))


def newest_control_endpoint() -> str:
    """Return control of the newest running system with this user's keys, or an empty string."""
    addresses = [system.control for system in running_systems() if system.keys == _key_folder()]
    return addresses[0] if addresses else ""


def other_systems() -> list[RunningSystem]:
    """Return the running systems of this user that have other keys, the newest first."""
    return [system for system in running_systems() if system.keys != _key_folder()]


def running_systems() -> list[RunningSystem]:
    """Return all running systems of this user, the newest first."""
    paths: list[Path] = []
    with contextlib.suppress(OSError):
        paths = [*_own_folder().iterdir()]
    systems = []
    for path in paths:
        # another system may end, and remove its file, at any time
        with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                control, _, keys = os.fsdecode(file.read()).partition("\n")
                if control:  # else not yet written
                    started_s = os.fstat(file.fileno()).st_mtime
                    systems.append((started_s, RunningSystem(control, keys)))
                continue
            if file.read():  # otherwise a starting system has not locked it yet
                path.unlink()  # the system has ended
    return [system for _, system in sorted(systems, reverse=True)]


def _not_running_text(others: Sequence[RunningSystem]) -> str:
    text = "kouxing is not running on this machine for this user; start it with 'kouxing run'"
    if not others:
        text += ", or set --control or KOUXING_CONTROL to the address of control"
    else:
        listed = ", ".join(f"{system.address} (keys: {system.keys})" for system in others)
        text += (
            f". A system with other keys runs at {listed}; to use it, set XDG_STATE_HOME to the"
            " folder that contains its key folder, and --control or KOUXING_CONTROL to its address"
        )
    return text


def _key_folder() -> str:
    with contextlib.suppress(RuntimeError):  # no home folder; an insecure system needs no keys
        return str(key_folder().resolve())
    return ""


def _own_folder() -> Path:
    """Return a folder that only this user can write to; raise ``OSError`` if that is impossible."""
    root = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    folder = Path(root) / f"kouxing-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    about = folder.lstat()
    if about.st_uid != os.getuid() or about.st_mode & 0o77:
        raise PermissionError
    return folder
