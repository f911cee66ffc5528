"""The faults command kills a service during a live session, and prints and writes its figures."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.commands import app
from kouxing.evaluation.system.faults import Timing


def test_the_command_prints_and_writes_the_same_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = "synthesizer"
    timing = Timing(length_s=3.0, fault_at_s=1.0, other_times_s=())
    monkeypatch.setattr("kouxing.evaluation.system.faults.TIMING", timing)
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
    ready = (logs / f"{fault}-1-s" / f"{service}.log").read_text("utf-8").count('"ready ')
    assert ready == 2, "it was not killed"
    face = outcome["face"]
    assert face["phones"] > 0
    assert face["stood_s"] > 0
    assert face["largest_step"] > 0
    assert f"{face['stood_s']:.2f}" in result.stdout


def test_an_unknown_fault_is_rejected() -> None:
    result = CliRunner().invoke(app, ["faults", "--fault", "flood"])
    assert result.exit_code != 0
    assert "no fault is named 'flood'" in str(result.exception)
