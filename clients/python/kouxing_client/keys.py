"""The CURVE key pair of this program, stored where kouxing's own commands store theirs."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from kouxing_client.errors import KouxingError
from kouxing_client.field_types import full_match

_FILE = "client.key"
_MAX_BYTES = 1000
Z85_KEY = r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}"  # 32 bytes
Z85Key = Annotated[str, full_match(Z85_KEY)]


@dataclass(frozen=True)
class Key:
    """A key pair and the public key of control, in Z85."""

    public: Z85Key
    secret: Z85Key
    control: Z85Key


def find_key() -> Key:
    """Return the user's key.

    The file is ``client.key`` in ``$CREDENTIALS_DIRECTORY``. If it does not exist there, it is in
    ``$XDG_STATE_HOME/kouxing``, by default ``~/.local/state/kouxing``.

    Raises
    ------
    KouxingError
        If there is no such file, or it is not a key file.
    """
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    if credentials and Path(credentials, _FILE).exists():
        return read_key(Path(credentials, _FILE))
    state = os.environ.get("XDG_STATE_HOME")
    folder = Path(state) if state else Path.home() / ".local" / "state"
    return read_key(folder / "kouxing" / _FILE)


def _open_nonblocking(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)  # opening a FIFO would block


def read_key(path: str | Path) -> Key:
    """Read a key file.

    Raises
    ------
    KouxingError
        If it cannot be read, or is not a key file.
    """
    try:
        with open(path, "rb", opener=_open_nonblocking) as file:  # also closes a folder
            return msgspec.json.decode(file.read(_MAX_BYTES), type=Key)
    except OSError as error:
        raise KouxingError(
            f"{path}: {error.strerror}. 'kouxing run' writes this file on its own machine. For "
            "another machine, run 'kouxing keys add NAME --role client' there and copy the file"
        ) from None
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError):
        raise KouxingError(
            f"{path} is not a valid key file; copy it from control's machine again"
        ) from None
