"""The benchmark of senders measures every kind of receiver."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.commands import app
from kouxing.evaluation.system.sending import TARGETS, VIEWER
from tests.system import VOWELS_FILE

pytestmark = [pytest.mark.bench, pytest.mark.alone]


def test_frames_arrive_at_every_receiver(tmp_path: Path) -> None:
    figures = tmp_path / "senders.json"
    arguments = ["senders", str(VOWELS_FILE), "--seconds", "10", "--json", str(figures)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    arrivals = json.loads(figures.read_text("utf-8"))
    targets = [*(url.format("HOST") for url in TARGETS), "vts://HOST", f"ws://HOST/{VIEWER}"]
    assert [each["target"] for each in arrivals] == targets
    assert all(each["num_frames"] > 100 for each in arrivals)
