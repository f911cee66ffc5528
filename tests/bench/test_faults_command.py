"""Services crash during a live session; its face only pauses."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.commands import app
from kouxing.evaluation.system.faults import Timing
from tests.system import SKIP_NO_AUDIO


def test_a_crash_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = "recognizer"
    timing = Timing(length_s=6.0, fault_at_s=3.2, other_times_s=())
    monkeypatch.setattr("kouxing.evaluation.system.faults.TIMING", timing)
    # a busy machine starts slowly
    monkeypatch.setattr("kouxing.evaluation.system.live.END_LIMIT_S", 60.0)
    for name, value in SKIP_NO_AUDIO.items():
        monkeypatch.setenv(name, value)
    fault, figures, logs = f"{service} killed", tmp_path / "faults.json", tmp_path / "logs"
    result = CliRunner().invoke(
        app,
        ["faults", "--fault", fault, "--logs", str(logs), "--json", str(figures)],
        env={"COLUMNS": "200"},
    )
    assert result.exit_code == 0, result.output
    assert fault in result.stdout
    (outcome,) = json.loads(figures.read_text(encoding="utf-8"))
    assert (outcome["fault"], outcome["failure"]) == (fault, "")
    ready = (logs / f"{fault}-3.2-s" / f"{service}.log").read_text("utf-8").count('"ready ')
    assert ready == 2, "it was not killed"
    face = outcome["face"]
    assert face["phones"] > 25
    assert face["stood_s"] > 0
    assert (face["phones_lost"], face["phones_doubled"]) == (0, 0)
    assert (face["frames_lost"], face["frames_doubled"]) == (0, 0)
    assert face["largest_step"] > 0


def test_an_unknown_fault_is_rejected() -> None:
    result = CliRunner().invoke(app, ["faults", "--fault", "flood"])
    assert result.exit_code != 0
    assert "no fault is named 'flood'" in str(result.exception)
