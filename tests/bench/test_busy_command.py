"""The busy command measures lateness, and prints and writes its figures."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.system import busy
from kouxing.evaluation.system.busy import STEP_S, BusyRun
from kouxing.evaluation.system.commands import app


def _run(lateness_s: list[tuple[float, float]], load_s: float) -> BusyRun:
    """Make a run from pairs of a duration and its lateness."""
    values = [late for lasts_s, late in lateness_s for _ in range(round(lasts_s / STEP_S))]
    return BusyRun(
        num_programs=1, quiet_median_s=0.1, lateness_s=values, load_s=load_s, missing=0.0
    )


def test_the_summary_has_worst_lateness_and_recovery_time() -> None:
    run = _run([(1.0, 0.0), (0.5, 0.4), (0.1, 0.2), (0.7, 0.6), (0.7, 0.1), (2.0, 0.04)], 2.0)
    assert run.worst_s == 0.6
    assert run.longest_s == pytest.approx(0.7)
    assert run.recovery_s == pytest.approx(1.0)
    assert _run([(5.0, 0.1)], 2.0).recovery_s is None


def test_the_command_prints_and_writes_the_same_figures(
    speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(busy, "SETTLE_S", 1.0)
    monkeypatch.setattr(busy, "QUIET_S", 1.0)
    monkeypatch.setattr(busy, "AFTER_S", 1.0)
    figures = tmp_path / "busy.json"
    arguments = ["busy", str(speech), "--programs", "1", "--seconds", "1"]
    result = CliRunner().invoke(app, [*arguments, "--json", str(figures)])
    assert result.exit_code == 0, result.output
    written = json.loads(figures.read_text(encoding="utf-8"))
    (run,) = written["runs"]
    assert len(run["lateness_s"]) == 100
    assert max(run["lateness_s"]) == written["summary"][0]["worst_s"]
    assert f"{max(run['lateness_s']):.2f}" in result.stdout
    assert written["speaking"]["recognizer"]["cpu_cores"] > 0
    assert written["idle"]["control"]["wake_ups"] > 0
