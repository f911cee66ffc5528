"""The load command prints, writes and plots its figures."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.system.commands import app
from kouxing.evaluation.tables import format_figure
from kouxing.services.service_kinds import KINDS


def test_the_command_prints_writes_and_plots_the_same_figures(
    speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kouxing.evaluation.system.load.SETTLE_S", 1.0)
    figures, picture = tmp_path / "load.json", tmp_path / "load.png"
    arguments = [
        "load",
        str(speech),
        "--sessions",
        "2",
        "--seconds",
        "1",
        "--language",
        "auto",
    ]
    result = CliRunner().invoke(
        app, [*arguments, "--json", str(figures), "--picture", str(picture)]
    )
    assert result.exit_code == 0, result.output
    load = json.loads(figures.read_text(encoding="utf-8"))
    assert [step["num_asked"] for step in load["steps"]] == [1, 2]
    for step in load["steps"]:
        assert step["num_sessions"] + sum(step["refusals"].values()) == step["num_asked"]
        assert 0 < step["delay_ms"]["p50"] <= step["delay_ms"]["p95"]
        assert set(step["cpu_cores"]) == {*KINDS, "client"}
        assert step["memory_mb"]["recognizer"] > 50
    assert format_figure(load["steps"][0]["delay_ms"]["p50"]) in result.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
