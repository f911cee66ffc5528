"""Half a minute of a stream that does not end: nothing drifts, and nothing is lost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.commands import app
from kouxing.evaluation.system import soak
from tests.system import DEMO

pytestmark = [pytest.mark.bench, pytest.mark.slow, pytest.mark.timeout(400)]


def test_half_a_minute_neither_drift_nor_lose_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(soak, "SAME_EVERY", 3)
    figures, picture = tmp_path / "soak.json", tmp_path / "soak.png"
    arguments = ["soak", str(DEMO / "bilabials-female.wav"), "--hours", "0.01"]
    result = CliRunner().invoke(
        app, [*arguments, "--json", str(figures), "--picture", str(picture)]
    )
    assert result.exit_code == 0, result.output
    written = json.loads(figures.read_text(encoding="utf-8"))
    rounds, summary = written["rounds"], written["summary"]
    assert rounds[-1]["media_s"] > 36
    assert [each["drift"] for each in rounds] == [0] * len(rounds)
    assert summary["irregular_frames"] == 0
    assert summary["unfinished_phones"] == 0
    assert summary["lost_phones"] == 0
    same = [each["num_phones"] for each in rounds if each["num_lost"] is not None]
    assert len(same) >= 2
    assert min(same) > 10
    assert len({each["num_phones"] for each in rounds}) > 1, "rounds are alike"
    assert "largest drift: 0" in result.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
