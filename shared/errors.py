"""Errors that name what is wrong and how to mend it."""

import sys


class UserError(Exception):
    """A mistake in what the user gave; the text names the thing and the fix.

    The command line prints the text without a traceback and exits with status 2.
    """


def install_command(package: str) -> str:
    """Return what installs a package, or an extra such as ``kouxing[camera]``, beside kouxing."""
    return f"{sys.executable} -m pip install '{package}'"
