"""CURVE keys: the identity of each process, and the list of keys that may connect.

The keys are in ``$XDG_STATE_HOME/kouxing`` or ``~/.local/state/kouxing``. The first process
creates the folder:

- ``NAME.key``: the key pair of a service or client, with control's public key;
- ``allowed``: the keys that may connect, one line ``PUBLIC-KEY NAME ROLE...`` each.

A file of the same name in ``$CREDENTIALS_DIRECTORY`` (a container secret or a systemd credential)
takes precedence and is only read.

Roles are ``client`` (opens sessions), ``operator`` (changes the faces of other sessions),
``service:KIND``, and ``subscriber:SESSION`` or ``subscriber:*``. Every role may request the status.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shlex
import stat
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import write_error, write_private
from kouxing.shared.files.user_file import read_text
from kouxing.shared.name_rules import NAME, NAME_RULE, is_name
from kouxing.shared.settings.endpoints import is_local, split_endpoint, with_key

if TYPE_CHECKING:
    from kouxing_client.keys import Key

CONTROL = "control"
CLIENT = "client"
CLIENT_ROLES = ("client", "operator")  # roles of the user of control's machine
MAX_KEYS = 1000  # with MAX_ROLES each, the keys fit in one message from control
MAX_ROLES = 16  # limit for a key
MAX_KEY_SHARE = 0.75  # fraction of the sessions, videos and connections that one key can have
_MAX_ALLOWED_BYTES = 768 * 1024
_MAX_FILE_BYTES = 1 << 20
_ALLOWED = "allowed"
_SUBSCRIBER = "subscriber:"
_ROLE = re.compile(rf"client|operator|service:[a-z-]{{1,64}}|subscriber:({NAME}|\*)")


class Grant(NamedTuple):
    """The name and the roles of a key."""

    name: str
    roles: tuple[str, ...]


Grants = Mapping[str, Grant]  # by public key


def key_folder() -> Path:
    """Return the folder of the keys. It may not exist yet."""
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "kouxing"


def load_key(name: str, roles: Collection[str], *, control: str = "") -> Key:
    """Return a key of this machine. On control's machine, create and allow a missing key.

    ``control`` is control's address; if empty, control runs on this machine. Raises ``UserError``
    if the key cannot be read or created, if other users can read it, or if it belongs to a
    different system than control's key.
    """
    if credential := _find_credential(f"{name}.key"):
        return read_key(credential)
    with _locked_folder() as folder:
        path, control_path = folder / f"{name}.key", folder / "control.key"
        if not path.exists() and not control_path.exists():
            _create_control_key(folder, path, roles, control)
        if not path.exists():
            _add_key(folder, path, name, roles)
        key = read_key(path)
        control_key = read_key(control_path) if control_path.exists() else None
        if control_key is not None and control_key.public != key.control:
            if name == CONTROL:
                raise _key_error(path)
            remove = shlex.join(("rm", str(control_path), str(folder / _ALLOWED)))
            raise UserError(
                f"{path} belongs to a different system than {control_path}. If control runs on"
                f" another machine, run: {remove}. If it runs here, run: {_replace_hint(path)}"
            )
        return key


def _create_control_key(folder: Path, path: Path, roles: Collection[str], control: str) -> None:
    """Create control's key because ``path`` is missing.

    Raises ``UserError`` if control runs elsewhere.
    """
    has_keys = any(folder.glob("*.key"))
    if path.stem == CONTROL and has_keys:
        raise UserError(
            f"{path} is missing, but other keys need it. Run this on control's machine."
            f" To run control here, first run: {_replace_hint(path)}"
        )
    if has_keys or (control and not is_local(split_endpoint(control, CONTROL)[0])):
        raise UserError(
            f"{path} is missing, and a new key can be created only on control's"
            f" machine. Run there: {_add_key_hint(roles)} and try again"
        )
    (folder / _ALLOWED).unlink(missing_ok=True)  # keys of another control
    _write(folder / "control.key", format_key(_new_key()))


def check_keys(kinds: Mapping[str, Collection[str]]) -> None:
    """Check that the keys of a system on this machine match, and create missing keys.

    ``kinds`` has the roles of each kind of service. Raises ``UserError`` with the command that
    fixes the key, or as ``load_key``.
    """
    import zmq  # noqa: PLC0415 (slow to import)

    roles_of = {**kinds, CLIENT: CLIENT_ROLES}
    keys = {name: load_key(name, roles) for name, roles in roles_of.items()}
    grants = read_grants()  # also of keys that were just created
    problems: dict[Path, str] = {}  # by key file
    for name, key in keys.items():
        path, grant = key_folder() / f"{name}.key", grants.get(key.public, Grant("", ()))
        if _find_credential(path.name):
            continue
        if zmq.curve_public(key.secret.encode()) != key.public.encode():
            problems[path] = f"{path}: the secret key does not belong to the public key"
        elif name != CONTROL and not {*roles_of[name]} <= {*grant.roles}:
            problems[path] = f"{key_folder() / _ALLOWED} does not allow {path}"
    if problems:
        raise UserError(f"{next(iter(problems.values()))}; run: {_replace_hint(*problems)}")


def _replace_hint(*paths: Path) -> str:
    """Return the command that removes keys, so that ``kouxing run`` creates new ones.

    A new key of control replaces all others.
    """
    if any(path.stem == CONTROL for path in paths):
        return shlex.join(("rm", "-r", str(paths[0].parent)))
    names = {grant.name for grant in _parse_grants(grants_file()).values()}
    revoke = [f"kouxing keys revoke {path.stem}" for path in paths if path.stem in names]
    return "; ".join([*revoke, shlex.join(("rm", "-r", *map(str, paths)))])


def load_user_key(*, control: str = "") -> Key:
    """Return the key of the user's commands and clients. Parameter and errors as ``load_key``."""
    return load_key(CLIENT, CLIENT_ROLES, control=control)


def load_local_keys() -> dict[str, Key]:
    """Return this machine's keys by name, without control's. Raises ``UserError`` as ``read_key``.

    The folder of the keys may not exist.
    """
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    folders = [key_folder(), *([Path(credentials)] if credentials else [])]
    paths = {path.stem: path for folder in folders for path in sorted(folder.glob("*.key"))}
    return {name: read_key(path) for name, path in paths.items() if name != CONTROL}


def control_endpoint(address: str, *, insecure: bool) -> str:
    """Return control's endpoint with, unless ``insecure``, its public key.

    Raises ``UserError`` if the user's key cannot be read (see ``load_key``).
    """
    return with_key(address, "" if insecure else load_user_key(control=address).control)


def rejection_hint(control: str, name: str, roles: Collection[str]) -> str:
    """Return an error text for a process of this machine that control rejects."""
    address, _, server_key = control.partition(" ")
    if not server_key:
        return (
            f"control at {address} rejects this machine: insecure = true is set only here,"
            " or see control's log"
        )
    path = key_folder() / f"{name}.key"
    return (
        f"control at {address} does not accept {path}. If control runs on this machine, run:"
        f" {_replace_hint(path)} (or set XDG_STATE_HOME as for control). Otherwise, run there:"
        f" {_add_key_hint(roles)}. A running service then restarts by itself"
    )


def format_key(key: Key) -> str:
    """Return the content of a key file."""
    return json.dumps(asdict(key), indent=1) + "\n"


def _add_key_hint(roles: Collection[str]) -> str:
    """Return the command that creates a key for this machine."""
    options = "".join(f" --role {role}" for role in roles)
    return f"kouxing keys add NAME{options}, then copy the file here"


def read_grants() -> dict[str, Grant]:
    """Return the allowed keys, by public key. The list may not exist yet.

    Raises ``UserError`` if the list cannot be read, or other users can change it.
    """
    if credential := _find_credential(_ALLOWED):
        return _read_grants(credential)
    with _locked_folder() as folder:
        return _read_grants(folder / _ALLOWED)


def grants_file() -> Path:
    """Return the file of ``read_grants``. Every change replaces the file."""
    return _find_credential(_ALLOWED) or key_folder() / _ALLOWED


def add_key(name: str, roles: Collection[str], path: Path) -> None:
    """Create and allow a key, and write it to a file for another machine.

    Raises ``UserError`` if the name is taken, a role is invalid, or this is not control's machine.
    """
    load_key(CONTROL, ())
    with _locked_folder() as folder:
        _add_key(folder, path, name, roles)


def revoke_key(name: str) -> None:
    """Revoke a key; raise ``UserError`` if no key has this name."""
    with _locked_folder() as folder:
        grants = _parse_grants(folder / _ALLOWED)  # unchecked, so that it works with too many keys
        remaining = {public: grant for public, grant in grants.items() if grant.name != name}
        if len(remaining) == len(grants):
            raise UserError(f"no key is named {name!r}; list them with 'kouxing keys list'")
        _write(folder / _ALLOWED, _format_grants(remaining))


def save_grants(grants: Grants) -> None:
    """Save the list that control sent, so that it is available after a restart.

    On control's machine, this does nothing, because the list there may be newer. Raises
    ``UserError`` if the list cannot be written.
    """
    with _locked_folder() as folder:
        is_control_machine = (folder / "control.key").exists()
        if not is_control_machine and _read_grants(folder / _ALLOWED) != grants:
            _write(folder / _ALLOWED, _format_grants(grants))


def may_subscribe(grant: Grant, topic: bytes) -> bool:
    """Return whether a key may subscribe to a topic prefix."""
    if any(role == f"{_SUBSCRIBER}*" or not role.startswith(_SUBSCRIBER) for role in grant.roles):
        return True
    _kind, *rest = topic.decode("ascii", "replace").split("/")
    return len(rest) == 2 and f"{_SUBSCRIBER}{rest[0]}" in grant.roles


def _new_key(control: str = "") -> Key:
    import zmq  # noqa: PLC0415 (slow to import)
    from kouxing_client.keys import Key  # noqa: PLC0415

    public, secret = (part.decode() for part in zmq.curve_keypair())
    return Key(public, secret, control or public)


def _add_key(folder: Path, path: Path, name: str, roles: Collection[str]) -> None:
    """Write a new key to a file and allow it."""
    if not is_name(name):
        raise UserError(f"{name!r} is not a valid name; {NAME_RULE}")
    for role in roles:
        if not _ROLE.fullmatch(role):
            raise UserError(
                f"{role!r} is not a role; use client, operator, service:KIND or subscriber:SESSION"
            )
    grants = _read_grants(folder / _ALLOWED)
    if any(grant.name == name for grant in grants.values()):
        raise UserError(
            f"{path}: another key has the name {name!r}; run 'kouxing keys revoke {name}' first"
        )
    key = _new_key(read_key(folder / "control.key").public)
    grants[key.public] = Grant(name, tuple(roles))
    _check_number(grants)
    _write(path, format_key(key))
    _write(folder / _ALLOWED, _format_grants(grants))


def read_key(path: Path) -> Key:
    """Return the key in a file.

    Raises ``UserError`` if it cannot be read, or other users can read it.
    """
    from kouxing_client import KouxingError, keys  # noqa: PLC0415 (slow to import)

    _check_private(path, 0o600)
    try:
        return keys.read_key(path)
    except KouxingError:
        raise _key_error(path) from None


def _key_error(path: Path) -> UserError:
    if path.parent != key_folder():
        return UserError(f"{path} is not a valid key file; copy it from control's machine again")
    return UserError(
        f"{path} is not a valid key file. If it came from another machine, copy it from there"
        f" again. Otherwise run: {_replace_hint(path)}"
    )


def _read_grants(path: Path) -> dict[str, Grant]:
    grants = _parse_grants(path)
    try:
        _check_number(grants)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return grants


def _parse_grants(path: Path) -> dict[str, Grant]:
    if not path.exists():
        return {}
    from kouxing_client.keys import Z85_KEY  # noqa: PLC0415 (slow to import)

    grants = {}
    for line in _read(path).splitlines():
        public, *name_and_roles = line.split() or [""]
        name, *roles = name_and_roles or [""]
        is_whole = re.fullmatch(Z85_KEY, public) and is_name(name)
        if not (is_whole and all(map(_ROLE.fullmatch, roles))):
            raise UserError(
                f"{path}: {line!r} is not of the form PUBLIC-KEY NAME ROLE...; delete this line,"
                f" or run: {_replace_hint(path.with_name('control.key'))}"
            )
        grants[public] = Grant(name, tuple(roles))
    return grants


def _check_number(grants: Grants) -> None:
    """Reject more keys or roles than fit in one message to the services."""
    for grant in grants.values():
        if len(grant.roles) > MAX_ROLES:
            raise UserError(
                f"{grant.name} has {len(grant.roles)} roles, but the maximum is {MAX_ROLES};"
                " use 'subscriber:*' to follow all sessions"
            )
    if len(grants) > MAX_KEYS:
        raise UserError(
            f"there are {len(grants)} keys, but the maximum is {MAX_KEYS};"
            " revoke some with 'kouxing keys revoke'"
        )
    if len(_format_grants(grants)) > _MAX_ALLOWED_BYTES:
        raise UserError("the keys have too many roles; revoke some with 'kouxing keys revoke'")


def _format_grants(grants: Grants) -> str:
    return "".join(
        f"{public} {' '.join((name, *roles))}\n" for public, (name, roles) in grants.items()
    )


@contextlib.contextmanager
def _locked_folder() -> Iterator[Path]:
    try:
        folder = key_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except (OSError, RuntimeError) as error:  # RuntimeError: no home folder
        reason = str(error)
        if isinstance(error, OSError):
            reason = f"{error.filename}: {error.strerror}"
        raise UserError(
            f"cannot use the key folder ({reason}); set XDG_STATE_HOME to a folder that you"
            " can write to, or create the key folder as your own, with mode 700"
        ) from None
    try:
        _check_private(folder, 0o700)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield folder
    finally:
        os.close(descriptor)


def _find_credential(name: str) -> Path | None:
    """Return a file in ``$CREDENTIALS_DIRECTORY``, None if it does not exist."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    path = Path(folder, name) if folder else None
    return path if path and path.exists() else None


def _check_private(path: Path, mode: int) -> None:
    """Reject a file that other users can read. Credentials may be readable by the group."""
    try:
        about = path.stat()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    if mode == 0o600 and not stat.S_ISREG(about.st_mode):
        raise UserError(f"{path} is not a regular file; run 'rm -r {path}'")
    is_given = path.parent == Path(os.environ.get("CREDENTIALS_DIRECTORY", ""))
    owners, others = ({0, os.geteuid()}, 0o037) if is_given else ({os.geteuid()}, 0o077)
    if about.st_uid not in owners:
        raise UserError(f"{path} belongs to another user; change its owner")
    if not about.st_mode & 0o400:
        raise UserError(f"no permission to read {path}; run 'chmod {mode:o} {path}' and restart")
    if about.st_mode & others:
        raise UserError(f"other users can read {path}; run 'chmod {mode:o} {path}' and restart")


def _read(path: Path) -> str:
    _check_private(path, 0o600)
    return read_text(path, _MAX_FILE_BYTES)


def _write(path: Path, text: str) -> None:
    try:
        write_private(path, text.encode("ascii"))
    except OSError as error:
        raise write_error(path, error) from None
