"""Who a process is, and who may talk to it: CURVE keys in a folder of the user's own.

The folder is ``$XDG_STATE_HOME/kouxing``, else ``~/.local/state/kouxing``, and belongs to one
system. Whatever starts first makes it. It has

- ``NAME.key``: a key pair of one service or client, with control's public key;
- ``allowed``: who may connect, a line ``PUBLIC-KEY NAME ROLE...`` each.

A file of the same name in ``$CREDENTIALS_DIRECTORY``, such as a container's secret or what systemd
gives a unit, counts instead, and is only read.

Roles are ``client`` (opens sessions), ``operator`` (changes the faces of others' sessions),
``service:KIND`` and ``subscriber:SESSION`` (or ``subscriber:*``); each may ask for the status.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

from kouxing.shared.endpoints import with_key
from kouxing.shared.errors import UserError

CONTROL = "control"
CLIENT = "client"
CLIENT_ROLES = ("client", "operator")  # of whoever uses control's machine
# What one message from control can tell the services.
MAX_KEYS = 1000
MAX_ROLES = 16  # of a key
_MAX_ALLOWED_BYTES = 768 * 1024
_ALLOWED = "allowed"
_SUBSCRIBER = "subscriber:"
_PUBLIC = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")  # Z85 of 32 bytes
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_ROLE = re.compile(r"client|operator|service:[a-z-]{1,64}|subscriber:([A-Za-z0-9_-]{1,64}|\*)")


@dataclass(frozen=True, slots=True)
class Key:
    """A key pair, and the public key of control; Z85, 40 characters each."""

    public: str
    secret: str
    control: str


@dataclass(frozen=True, slots=True)
class Peer:
    """Who sent something to a ROUTER socket; the same peer may connect again."""

    address: bytes = b""  # what it calls itself, or a name made by the socket
    key: str = ""  # its public key, proved; empty where all is plain
    connection: int = field(default=0, compare=False)  # its number; 0: it has ended


NOBODY = Peer()


class Guest(NamedTuple):
    """Whose key it is, and what its owner may do."""

    name: str
    roles: tuple[str, ...]


Guests = Mapping[str, Guest]  # by public key


def key_folder() -> Path:
    """Return where the keys are; it need not exist yet."""
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "kouxing"


def own_key(name: str, roles: Collection[str]) -> Key:
    """Return a key of this machine; on control's, one that does not exist is made and allowed.

    Raises
    ------
    UserError
        If the key cannot be read or made, or others could read it, too.
    """
    if credential := _credential(f"{name}.key"):
        return read_key(credential)
    with _locked_folder() as folder:
        path = folder / f"{name}.key"
        if not path.exists():
            if not (folder / "control.key").exists():
                if any(folder.glob("*.key")):
                    raise UserError(
                        f"{path} is missing, and control's key is not here to allow a new one; "
                        f"on control's machine: {how_to_add(roles)}"
                    )
                _write(folder / "control.key", _new_key())
            if name != CONTROL:
                _add_key(folder, path, name, roles)
        return read_key(path)


def user_key() -> Key:
    """Return the key of the user's own commands and clients; raises as ``own_key``."""
    return own_key(CLIENT, CLIENT_ROLES)


def control_endpoint(address: str, *, insecure: bool) -> str:
    """Return where a client finds control: address and, unless all is plain, public key.

    Raises
    ------
    UserError
        As ``own_key``.
    """
    return with_key(address, "" if insecure else user_key().control)


def refusal(control: str, name: str, roles: Collection[str]) -> str:
    """Return what to say when control refuses a process of this machine, with its key or none."""
    address, _, server_key = control.partition(" ")
    if not server_key:
        return (
            f"control at {address} refuses this machine: insecure = true is set here, but not"
            " there, or its log says why"
        )
    return (
        f"control at {address} does not accept {key_folder() / name}.key; if it"
        f" runs on this machine, start it again, else make a key there: {how_to_add(roles)}"
    )


def key_text(key: Key) -> str:
    """Return the content of a key's file."""
    return json.dumps(asdict(key), indent=1) + "\n"


def how_to_add(roles: Collection[str]) -> str:
    """Return what makes a key with some roles, for messages about a key that is missing."""
    options = "".join(f" --role {role}" for role in roles)
    return f"kouxing keys add NAME{options}; then copy the file here"


def read_guests() -> dict[str, Guest]:
    """Return who may connect, by public key; nobody if that was never said.

    Raises
    ------
    UserError
        If the list cannot be read, or others could change it.
    """
    if credential := _credential(_ALLOWED):
        return _read_guests(credential)
    with _locked_folder() as folder:
        return _read_guests(folder / _ALLOWED)


def guests_file() -> Path:
    """Return the file that ``read_guests`` reads; a change puts another in its place."""
    return _credential(_ALLOWED) or key_folder() / _ALLOWED


def add_guest(name: str, roles: Collection[str], path: Path) -> None:
    """Make a key with some roles, allow it, and write it to a file for another machine.

    Raises
    ------
    UserError
        If the name is taken, a role is none, or this is not control's machine.
    """
    own_key(CONTROL, ())
    with _locked_folder() as folder:
        _add_key(folder, path, name, roles)


def revoke_guest(name: str) -> None:
    """Allow a key no longer.

    Raises
    ------
    UserError
        If there is no key of that name.
    """
    with _locked_folder() as folder:
        guests = _parse_guests(folder / _ALLOWED)  # of too many it may revoke some
        kept = {public: guest for public, guest in guests.items() if guest.name != name}
        if len(kept) == len(guests):
            raise UserError(f"no key is called {name!r}; 'kouxing keys list' shows all")
        _write(folder / _ALLOWED, _lines(kept))


def save_guests(guests: Guests) -> None:
    """Keep what control has told, so that a service knows its guests when it starts again.

    On control's own machine the list is there, and perhaps newer.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    with _locked_folder() as folder:
        is_controls = (folder / "control.key").exists()
        if not is_controls and _read_guests(folder / _ALLOWED) != guests:
            _write(folder / _ALLOWED, _lines(guests))


def may_follow(guest: Guest, topic: bytes) -> bool:
    """Return whether somebody may subscribe to the messages whose topic begins so."""
    if any(role == f"{_SUBSCRIBER}*" or not role.startswith(_SUBSCRIBER) for role in guest.roles):
        return True
    _kind, *rest = topic.decode("ascii", "replace").split("/")
    return len(rest) == 2 and f"{_SUBSCRIBER}{rest[0]}" in guest.roles


def _new_key(control: str = "") -> str:
    import zmq  # noqa: PLC0415 (commands that talk to nobody start without)

    public, secret = (part.decode() for part in zmq.curve_keypair())
    return key_text(Key(public, secret, control or public))


def _add_key(folder: Path, path: Path, name: str, roles: Collection[str]) -> None:
    """Write a new key to a file, then allow it."""
    if not _NAME.fullmatch(name):
        raise UserError(f"no key can be called {name!r}; use letters, digits, '-' and '_'")
    for role in roles:
        if not _ROLE.fullmatch(role):
            raise UserError(
                f"{role!r} is no role; use client, operator, service:KIND or subscriber:SESSION"
            )
    guests = _read_guests(folder / _ALLOWED)
    if any(guest.name == name for guest in guests.values()):
        raise UserError(f"a key is called {name!r}; first 'kouxing keys revoke {name}'")
    text = _new_key(read_key(folder / "control.key").public)
    guests[json.loads(text)["public"]] = Guest(name, tuple(roles))
    _check_number(guests)
    _write(path, text)
    _write(folder / _ALLOWED, _lines(guests))


def read_key(path: Path) -> Key:
    """Return the key in a file.

    Raises
    ------
    UserError
        If it cannot be read, or others could read it, too.
    """
    try:
        key = Key(**json.loads(_read(path)))
        if all(_PUBLIC.fullmatch(part) for part in (key.public, key.secret, key.control)):
            return key
    except (ValueError, TypeError):
        pass
    raise UserError(f"{path} is no key file; without it a new key is made on control's machine")


def _read_guests(path: Path) -> dict[str, Guest]:
    guests = _parse_guests(path)
    try:
        _check_number(guests)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return guests


def _parse_guests(path: Path) -> dict[str, Guest]:
    if not path.exists():
        return {}
    guests = {}
    for line in _read(path).splitlines():
        public, *named = line.split() or [""]
        name, *roles = named or [""]
        is_whole = _PUBLIC.fullmatch(public) and _NAME.fullmatch(name)
        if not (is_whole and all(map(_ROLE.fullmatch, roles))):
            raise UserError(f"{path}: {line!r} is not PUBLIC-KEY NAME ROLE...")
        guests[public] = Guest(name, tuple(roles))
    return guests


def _check_number(guests: Guests) -> None:
    """Refuse more than the services can be told."""
    for guest in guests.values():
        if len(guest.roles) > MAX_ROLES:
            raise UserError(
                f"{guest.name} has {len(guest.roles)} roles, a key may have {MAX_ROLES};"
                " 'subscriber:*' follows all sessions"
            )
    if len(guests) > MAX_KEYS:
        raise UserError(
            f"{len(guests)} keys would be allowed, {MAX_KEYS} may be; 'kouxing keys revoke' some"
        )
    if len(_lines(guests)) > _MAX_ALLOWED_BYTES:
        raise UserError("the keys have too many roles in all; 'kouxing keys revoke' some")


def _lines(guests: Guests) -> str:
    return "".join(
        f"{public} {' '.join((name, *roles))}\n" for public, (name, roles) in guests.items()
    )


@contextlib.contextmanager
def _locked_folder() -> Iterator[Path]:
    try:
        folder = key_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
        raise UserError(f"no place for keys: {error}; name a folder by XDG_STATE_HOME") from None
    try:
        _check_private(folder, 0o700)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield folder
    finally:
        os.close(descriptor)


def _credential(name: str) -> Path | None:
    """Return a file that whoever started this process gives it, if it does."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    path = Path(folder, name) if folder else None
    return path if path and path.exists() else None


def _check_private(path: Path, mode: int) -> None:
    """Refuse what others can read; root may give a credential to this process's group."""
    about = path.stat()
    is_given = path.parent == Path(os.environ.get("CREDENTIALS_DIRECTORY", ""))
    owners, others = ({0, os.geteuid()}, 0o037) if is_given else ({os.geteuid()}, 0o077)
    if about.st_uid not in owners:
        raise UserError(f"{path} belongs to another user; keys must be your own")
    if about.st_mode & others:
        raise UserError(f"others can read {path}; 'chmod {mode:o} {path}', then start again")


def _read(path: Path) -> str:
    try:
        _check_private(path, 0o600)
        return path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read: {error}") from None


def _write(path: Path, text: str) -> None:
    """Write a file that nobody else can read, whole or not at all."""
    new = path.with_name(f"{path.name}.new")
    try:
        new.unlink(missing_ok=True)
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(text)
        new.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
