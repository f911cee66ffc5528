"""Removes columns of times or names that every line of a text has next to its spoken part."""

import re
from collections.abc import Sequence
from itertools import pairwise

_LINE = re.compile(  # up to the first Chinese character, and after the last one
    "(?P<before>[^\u3400-\u9fff]*)(?P<spoken>[\u3400-\u9fff]|[\u3400-\u9fff].*[^\0-\x7f])"
    "(?P<after>[\0-\x7f]*)"
)
_HEADER = re.compile(r"[A-Za-z_ ]+(?:[,;|\t][A-Za-z_ ]+)+")  # names of columns
_TIME = re.compile(r"(?<![\w.])\d+(?:[:'′]\d+)*(?:\.\d+)?")
_TIME_LIKE = re.compile(r"\d[:'′.]\d|\ds\b")
_SEPARATOR = re.compile(r"[(\[{<【（|;,=:~\t\"]|^\s*s\b")
_NAME_BEFORE = re.compile(r"[\w./-]*\d[\w./-]*[|\t]|[A-Za-z][\w./-]*\d[\w./-]* +")
_NAME_AFTER = re.compile(r"[ \t]*\([A-Za-z][\w./-]*\d\)[ \t]*")


def remove_columns(text: str) -> str:
    """Remove columns of times, or of names with a number, from the lines of a text.

    Times increase from line to line. A text of a single line has no columns.
    """
    lines = [line.strip(" ") for line in text.split("\n") if line.strip()]
    if len(lines) > 2 and _HEADER.fullmatch(lines[0]):
        del lines[0]
    parts = [match for line in lines if (match := _LINE.fullmatch(line))]
    if len(parts) < 2 or len(parts) < len(lines):
        return text
    before, after = ([match[side] for match in parts] for side in ("before", "after"))
    if _are_times(before) or _are_names(before, _NAME_BEFORE):
        before = [""] * len(parts)
    if _are_times(after) or _are_names(after, _NAME_AFTER):
        after = [""] * len(parts)
    rows = zip(before, (match["spoken"] for match in parts), after, strict=True)
    remaining = ["".join(row) for row in rows]
    return text if remaining == lines else "\n".join(remaining)


def _are_times(cells: Sequence[str]) -> bool:
    rows = [[_seconds(time) for time in _TIME.findall(cell)][-2:] for cell in cells]
    are_single = all(
        len(row) == 1 and _TIME_LIKE.search(cell) and _SEPARATOR.search(_TIME.sub("", cell))
        for row, cell in zip(rows, cells, strict=True)
    )
    return (
        (are_single or all(len(row) == 2 for row in rows))
        and all(row[0] <= row[-1] for row in rows)
        and all(row[0] < following[0] for row, following in pairwise(rows))
    )


def _are_names(cells: Sequence[str], pattern: re.Pattern[str]) -> bool:
    return len(set(cells)) == len(cells) and all(map(pattern.fullmatch, cells))


def _seconds(time: str) -> float:
    value = 0.0
    for part in re.split("[:'′]", time):
        value = 60 * value + float(part)
    return value
