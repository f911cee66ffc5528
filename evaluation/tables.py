"""Print figures as tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console
from rich.table import Table


def print_table(
    console: Console, title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]
) -> None:
    """Print a table; a row may lack its last cells."""
    table = Table(title=title or None, box=box.SIMPLE, padding=(0, 1, 0, 0), title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def format_number(value: float | None, form: str = ".2f") -> str:
    """Format a figure; None is a dash."""
    return "-" if value is None else format(value, form)


def percent(rate: float | None) -> str:
    """Format a rate as a percentage; None is a dash."""
    return format_number(None if rate is None else 100 * rate, ".1f")
