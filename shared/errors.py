"""The exception for users' mistakes, and helpers for its text."""

import importlib.util
import sys

USER_ERROR = 2  # exit status of a program after a ``UserError``


class UserError(Exception):
    """A mistake in the user's input. The text names the cause and the remedy.

    The command line prints the text without a traceback and exits with ``USER_ERROR``.
    """


def install_command(package: str) -> str:
    """Return the command that adds a package, or an extra such as ``kouxing[camera]``."""
    if importlib.util.find_spec("pip") is None:  # an environment of uv
        return f"uv pip install --python {sys.executable} '{package}'"
    return f"{sys.executable} -m pip install '{package}'"


def prefix_name(name: str, text: str) -> str:
    """Prefix a message with the name of its service, unless it already starts with it."""
    return text if text.startswith((f"{name}:", f"{name}.")) else f"{name}: {text}"
