"""Reads tables of corpora: tab-separated files with a header, without quoting."""

import csv
from pathlib import Path

from kouxing.shared.user_file import read_text, split_lines

_MAX_BYTES = 16 << 20


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table by column; missing cells are empty.

    Raises ``UserError`` if the file is missing, is not text or is larger than 16 MB.
    """
    lines = split_lines(path, read_text(path, _MAX_BYTES))
    return list(csv.DictReader(lines, restval="", delimiter="\t", quoting=csv.QUOTE_NONE))
