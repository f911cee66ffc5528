"""Tables of figures, for the console and for docs/results.md."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kouxing.shared.command.terminal import print_table, write_json

Figures = Mapping[str, Any]  # results as in a JSON file


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""  # only on the console


def show_results(json_file: Path | None, results: object, *tables: Table) -> None:
    """Print the tables of a command, and write its results to a JSON file (None: no file)."""
    for table in tables:
        print_table(table.columns, table.rows, title=table.title)
    write_json(json_file, results)


def figures_table(results: Mapping[str, Figures]) -> Table:
    """Return a table of all figures: a row for each figure, a column for each of the results.

    The rows have the names in the JSON file, such as ``cpu_cores, recognizer``.
    """
    columns = {title: dict(_flatten(figures)) for title, figures in results.items()}
    names = dict.fromkeys(name for column in columns.values() for name in column)
    rows = [
        [name, *(format_figure(column.get(name)) for column in columns.values())] for name in names
    ]
    return Table(("figure", *columns), rows)


def _flatten(figures: Figures, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}, ")
        else:
            yield f"{prefix}{name}", value


def format_figure(value: Any) -> str:
    """Format a value of a JSON file: floats with three digits, at most three after the point.

    >>> format_figure(0.01234), format_figure(12.34), format_figure(1234.5), format_figure([4, 3])
    ('0.012', '12.3', '1234', '4 / 3')
    """
    if isinstance(value, list | tuple):
        return join_values(map(format_figure, value))
    if isinstance(value, float):
        num_decimals = sum(abs(value) < limit for limit in (1.0, 10.0, 100.0))
        return f"{value:.{num_decimals}f}"
    return "-" if value is None else str(value)


def format_number(value: float | None, format_spec: str = ".2f") -> str:
    """Format a figure; None is a dash."""
    return "-" if value is None else format(value, format_spec)


def percent(rate: float | None, format_spec: str = ".1f") -> str:
    """Format a rate as a percentage; None is a dash."""
    return format_number(None if rate is None else 100 * rate, format_spec)


def join_values(values: Iterable[str]) -> str:
    """Join several values in one cell."""
    return " / ".join(values)
