"""Tables fit into the terminal and keep words whole."""

from __future__ import annotations

import itertools
import re
from io import StringIO

import pytest
from rich.console import Console

from kouxing.shared.terminal import print_table

COLUMNS = ("scale", "condition", "all scores", "without outliers", "judges", "outliers")
ROWS = [
    ("sync", "scheme3-ferguson-blocks (hidden reference)", "3.98 ± 0.21", "4.01 ± 0.18", "12"),
    ("realism", "[bold]真人", "4.50 ± 0.10", "4.50 ± 0.10", "12", "0 of 240"),
]


@pytest.mark.parametrize("width", [120, 80, 40])
def test_a_table_fits_and_keeps_words_whole(width: int) -> None:
    text = StringIO()
    print_table(Console(file=text, width=width), "mean opinion scores", COLUMNS, ROWS)
    printed = text.getvalue()
    words = {word for cell in itertools.chain(COLUMNS, *ROWS) for word in cell.split()}
    assert words <= set(re.split(r"[\s:]+", printed))
    assert max(map(len, printed.splitlines())) <= width


def test_values_stay_whole_while_a_long_cell_wraps() -> None:
    text = StringIO()
    metrics = ", ".join(f"latency_{number}_p95 {number}.5" for number in range(9))
    print_table(
        Console(file=text, width=80), "", ("last seen", "metrics"), [("0.1 s ago", metrics)]
    )
    assert "0.1 s ago  latency_0_p95 0.5, latency_1_p95" in text.getvalue()
