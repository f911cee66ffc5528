"""The exceptions for mistakes of users and clients, and helpers for their texts."""

import importlib.util
import sys

USER_ERROR = 2  # exit status of a program after a ``UserError``


class UserError(Exception):
    """A mistake in the user's input. The text names the cause and the remedy.

    The command line prints the text without a traceback and exits with ``USER_ERROR``.
    """


class StartFailure(UserError):
    """A fault that keeps a service from serving a session; ``code`` is for the client."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class Rejected(Exception):
    """A message that a service rejects. The sender receives these fields in ``error``.

    A text that is too long for a message is cut off: it can contain the text of any exception.
    """

    def __init__(self, code: str, text: str, retry_after_s: float | None = None) -> None:
        from kouxing_client.field_types import MAX_TEXT  # noqa: PLC0415 - loads ZeroMQ

        super().__init__(text)
        self.code = code
        self.text = text[:MAX_TEXT]
        self.retry_after_s = retry_after_s


def install_command(package: str) -> str:
    """Return the command that adds a package, or an extra such as ``kouxing[camera]``."""
    if importlib.util.find_spec("pip") is None:  # an environment of uv
        return f"uv pip install --python {sys.executable} '{package}'"
    return f"{sys.executable} -m pip install '{package}'"


def prefix_name(name: str, text: str) -> str:
    """Prefix a message with the name of its service, unless it already starts with it."""
    return text if text.startswith((f"{name}:", f"{name}.")) else f"{name}: {text}"
