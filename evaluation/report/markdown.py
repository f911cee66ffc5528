"""Tables in Markdown, and the numbers in their cells."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Results = Mapping[str, Any]  # result of each measured step, by its name
Table = tuple[Sequence[str], Sequence[Sequence[str]]]  # columns and rows

UNKNOWN = "-"


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    columns, rows = table
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def bullets(sentences: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return "".join(f"- {sentence}\n" for sentence in sentences)


def format_number(value: float | None, digits: int = 2) -> str:
    """Format a number; None is a dash."""
    return UNKNOWN if value is None else f"{value:.{digits}f}"


def format_percent(rate: float | None, digits: int = 0) -> str:
    """Format a rate as a percentage without its sign; None is a dash."""
    return UNKNOWN if rate is None else f"{100 * rate:.{digits}f}"


def join_values(values: Iterable[str]) -> str:
    """Join several values in one cell."""
    return " / ".join(values)
