"""Reads tables of corpora: tab-separated files with a header, without quoting."""

import csv
from collections.abc import Sequence
from pathlib import Path

from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import check_content, read_text, split_lines

_MAX_BYTES = 256 << 20
_MAX_ROWS = 1_000_000
_SPELLINGS = {"licence": "license"}


def read_rows(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Return the rows of a table by column; missing cells are empty.

    Raises ``UserError`` if the file is missing, is not text, is too large or damaged, or lacks one
    of ``columns``. A column may have several names: ``pinyin or text``. The British spelling of
    the column ``license`` is also read.
    """
    rows: list[dict[str, str]] = []
    with check_content(path, "a table"):
        lines = filter(str.strip, split_lines(path, read_text(path, _MAX_BYTES)))
        table = csv.DictReader(lines, restval="", delimiter="\t", quoting=csv.QUOTE_NONE)
        table.fieldnames = [_SPELLINGS.get(name, name) for name in table.fieldnames or ()]
        known = set(table.fieldnames)
        missing = [column for column in columns if known.isdisjoint(column.split(" or "))]
        if missing:
            word = "column" if len(missing) == 1 else "columns"
            existing = ", ".join(table.fieldnames) or "no columns"
            raise UserError(f"{path} lacks the {word} {', '.join(missing)}; it has {existing}")
        for row in table:
            if len(rows) == _MAX_ROWS:
                raise UserError(f"{path} has more than {_MAX_ROWS} rows; split it")
            rows.append({name: cell for name, cell in row.items() if name})  # without extra cells
    return rows
