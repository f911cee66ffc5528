"""Who this program is: a CURVE key pair, found where kouxing's own commands find theirs."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

from kouxing_client.errors import KouxingError

_FILE = "client.key"


@dataclass(frozen=True)
class Key:
    """A key pair, and the public key of control; Z85, 40 characters each."""

    public: str
    secret: str
    control: str


def find_key() -> Key:
    """Return the user's key.

    It is ``client.key`` in ``$CREDENTIALS_DIRECTORY``, else in ``$XDG_STATE_HOME/kouxing``, else in
    ``~/.local/state/kouxing``.

    Raises
    ------
    KouxingError
        If there is none, or it is no key.
    """
    given = os.environ.get("CREDENTIALS_DIRECTORY")
    if given and Path(given, _FILE).exists():
        return read_key(Path(given, _FILE))
    state = os.environ.get("XDG_STATE_HOME")
    folder = Path(state) if state else Path.home() / ".local" / "state"
    return read_key(folder / "kouxing" / _FILE)


def read_key(path: str | Path) -> Key:
    """Return the key in a file.

    Raises
    ------
    KouxingError
        If it cannot be read, or is no key.
    """
    try:
        fields = json.loads(Path(path).read_text(encoding="ascii"))
        key = Key(*(fields[name] for name in ("public", "secret", "control")))
    except OSError as error:
        raise KouxingError(
            f"{path}: {error.strerror}; 'kouxing run' makes it on its own machine, and "
            "'kouxing keys add NAME --role client' there makes one to be copied here"
        ) from None
    except (ValueError, KeyError, TypeError):
        raise KouxingError(f"{path} is no key file") from None
    if not all(isinstance(part, str) and len(part) == 40 for part in vars(key).values()):
        raise KouxingError(f"{path} is no key file")
    return key
