"""Errors that name what is wrong and how to mend it."""


class UserError(Exception):
    """A mistake in what the user gave; the text names the thing and the fix.

    The command line prints the text without a traceback and exits with status 2.
    """
