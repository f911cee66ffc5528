"""Format figures for tables."""

from __future__ import annotations


def format_number(value: float | None, form: str = ".2f") -> str:
    """Format a figure; None is a dash."""
    return "-" if value is None else format(value, form)


def percent(rate: float | None) -> str:
    """Format a rate as a percentage; None is a dash."""
    return format_number(None if rate is None else 100 * rate, ".1f")
