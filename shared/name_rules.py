"""The rules for names of sessions and keys."""

import re

NAME = "[A-Za-z0-9_-]{1,64}"
NAME_RULE = "use up to 64 letters, digits, '-' and '_'"


def is_name(text: str) -> bool:
    """Return whether a text is a valid name."""
    return re.fullmatch(NAME, text) is not None
