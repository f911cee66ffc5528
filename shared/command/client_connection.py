"""Connects a command to control of a running system."""

import contextlib
from collections.abc import Iterator

from kouxing_client import Client, KouxingError, Refused
from kouxing_client.keys import Key

from kouxing.shared.errors import UserError


@contextlib.contextmanager
def connect_client(
    control: str, *, key: Key | None = None, timeout_s: float = 10.0
) -> Iterator[Client]:
    """Connect to control; on leaving, raise a ``KouxingError`` as a ``UserError``.

    ``control`` is the address and, with encryption, control's public key, as ``control_endpoint``
    returns it. If ``key`` is None, the user's key is used. Control may start within ``timeout_s``.
    """
    try:
        insecure = " " not in control
        with Client(
            control, key=key, insecure=insecure, timeout_s=timeout_s, start_s=timeout_s
        ) as client:
            yield client
    except Refused as refusal:
        raise UserError(refusal.text) from refusal
    except KouxingError as error:
        raise UserError(str(error)) from error
