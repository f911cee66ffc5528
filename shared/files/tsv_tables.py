"""Reads the tab-separated tables of packages, which may contain comments."""

import csv
from importlib import resources


def read_table(package: str, name: str) -> list[dict[str, str]]:
    """Return the rows of a package's table; lines that start with ``#`` are comments.

    Raises ``OSError`` if the package has no such table.
    """
    text = resources.files(package).joinpath(name).read_text("utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines, delimiter="\t"))
