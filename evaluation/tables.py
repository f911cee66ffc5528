"""Format figures for tables."""

from collections.abc import Sequence
from string import ascii_uppercase


def format_number(value: float | None, format_spec: str = ".2f") -> str:
    """Format a figure; None is a dash."""
    return "-" if value is None else format(value, format_spec)


def percent(rate: float | None, format_spec: str = ".1f") -> str:
    """Format a rate as a percentage; None is a dash."""
    return format_number(None if rate is None else 100 * rate, format_spec)


def letters_of(names: Sequence[str]) -> tuple[dict[str, str], str]:
    """Return a letter for each of several models, because paths are too long for a column.

    The second value explains the letters. A single model needs no letter.
    """
    if len(names) == 1:
        return {names[0]: ""}, names[0]
    pairs = (first + last for first in ("", *ascii_uppercase) for last in ascii_uppercase)
    letters = dict(zip(names, pairs, strict=False))
    return letters, ", ".join(f"{letter}: {name}" for name, letter in letters.items())
