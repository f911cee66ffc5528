"""Tables fit into the terminal and keep words whole."""

import itertools
import re

import pytest

from kouxing.evaluation.tables import figures_table
from kouxing.shared.command.terminal import print_table

COLUMNS = ("scale", "condition", "all scores", "without outliers", "judges", "outliers")
ROWS = [
    ("sync", "scheme3-ferguson-blocks (hidden reference)", "3.98 ± 0.21", "4.01 ± 0.18", "12"),
    ("realism", "[bold]真人", "4.50 ± 0.10", "4.50 ± 0.10", "12", "0 of 240"),
]


@pytest.mark.parametrize("width", [120, 80, 40])
def test_a_table_fits_and_keeps_words_whole(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    print_table(COLUMNS, ROWS, title="mean opinion scores")
    printed = capsys.readouterr().out
    words = {word for cell in itertools.chain(COLUMNS, *ROWS) for word in cell.split()}
    assert words <= set(re.split(r"[\s:]+", printed))
    assert max(map(len, printed.splitlines())) <= width


def test_the_table_of_figures_has_a_column_for_each_result() -> None:
    first = {"num": 3, "delay_ms": {"p50": 1.234, "p95": 12.34}, "size": (4, 3)}
    second = {"num": 1234.5, "delay_ms": {}, "note": None}
    table = figures_table({"1": first, "2": second})
    assert table.columns == ("figure", "1", "2")
    assert table.rows == [
        ["num", "3", "1234"],
        ["delay_ms, p50", "1.23", "-"],
        ["delay_ms, p95", "12.3", "-"],
        ["size", "4 / 3", "-"],
        ["note", "-", "-"],
    ]
