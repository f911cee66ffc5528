"""The command that plays workers and sessions says what they cost one control."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.commands import app
from kouxing.evaluation.system import control_scale

pytestmark = pytest.mark.bench


def test_it_opens_all_sessions_and_prints_what_they_cost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))  # which it changes
    monkeypatch.setattr(control_scale, "SETTLE_S", 1.0)
    monkeypatch.setattr(control_scale, "MEASURE_S", 2.0)
    figures = tmp_path / "control.json"
    arguments = ["control", "--workers", "20", "--sessions", "100", "--json", str(figures)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    costs = json.loads(figures.read_text(encoding="utf-8"))
    assert [(each["num_workers"], each["num_sessions"]) for each in costs] == [
        (2, 1),
        (2, 10),
        (20, 100),
    ]
    for cost in costs:
        assert cost["heartbeats_per_s"] > 0
        assert cost["cpu_share"] > 0
        assert cost["memory_mb"] > 10
        assert 0 < cost["open_ms_p50"] <= cost["open_ms_p95"]
        assert f"{cost['heartbeats_per_s']:.0f}" in result.stdout
