"""Tables in Markdown, and the physical floor that several of them show."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Results = Mapping[str, Any]  # result of each measured step, by its name
Table = tuple[Sequence[str], Sequence[Sequence[str]]]  # columns and rows

_FRAME_MS, _TICK_MS = 20, 17  # frame of the face; tick of a display at 60 Hz


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    columns, rows = table
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def bullets(sentences: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return "".join(f"- {sentence}\n" for sentence in sentences)


def join_values(values: Iterable[str]) -> str:
    """Join several values in one cell."""
    return " / ".join(values)


def display_floor_ms(look_ahead_ms: int) -> int:
    """Return the minimum time from a sound to its image: look-ahead, frame and display tick."""
    return look_ahead_ms + _FRAME_MS + _TICK_MS
