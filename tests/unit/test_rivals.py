"""Tables of other lip-sync programs: loudness needs no package; a missing package is an error."""

from pathlib import Path

import numpy as np
import pytest

from kouxing.evaluation.lips.curve_tables import read_table
from kouxing.evaluation.rivals import tables
from kouxing.evaluation.rivals.tables import LOUDNESS, write_tables
from kouxing.shared.errors import UserError
from tests.lip_clips import write_held_out_clip


def test_loudness_rises_with_the_voice(tmp_path: Path) -> None:
    write_held_out_clip(tmp_path)
    write_tables(tmp_path, tmp_path / "out", [LOUDNESS])
    path = tmp_path / "out" / LOUDNESS / "cam_1.csv"
    table = read_table(path)
    assert table.names == ("opening",)
    assert np.diff(table.time_s) == pytest.approx(0.01)
    assert table.values.min() < 0.3
    assert table.values.max() == 1.0
    path.write_text("t,opening\n0,0.5\n")
    write_tables(tmp_path, tmp_path / "out", [LOUDNESS])
    assert len(read_table(path).values) == 1  # existing tables stay


def test_unknown_and_missing_programs_are_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match="unknown program: wava; choose from headaudio, "):
        write_tables(tmp_path, tmp_path / "out", ["wava"])
    write_held_out_clip(tmp_path)
    monkeypatch.setattr(tables, "FOLDER", tmp_path)
    for program in ("headaudio", "pylipsync"):
        with pytest.raises(UserError, match="is not installed; run 'make report'"):
            write_tables(tmp_path, tmp_path / "out", [program])
