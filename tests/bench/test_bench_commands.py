"""Each command of ``kouxing bench`` prints and writes the same figures."""

import contextlib
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kouxing_client import Session
from numpy.typing import NDArray
from typer.testing import CliRunner

from kouxing.evaluation.system import busy, costs, latency, live, load, page
from kouxing.evaluation.system.busy import STEP_S, BusyRun
from kouxing.evaluation.system.commands import app
from kouxing.evaluation.tables import format_figure
from kouxing.services.service_kinds import KINDS
from tests.system import System


@pytest.fixture
def _same_services(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands use the services that already run, instead of starting their own."""

    @contextlib.contextmanager
    def run(*_: object) -> Iterator[System]:
        yield system

    monkeypatch.setattr(busy, "run_all_services", run)
    monkeypatch.setattr(load, "run_all_services", run)
    monkeypatch.setattr(page, "LocalSystem", run)


def speak_without_deadline(sessions: Sequence[Session], sound: NDArray[np.float32]) -> Any:
    """Stream audio, and also count the frames that arrive after its end, as on a busy machine."""
    all_received = live.speak(sessions, sound)
    for received in all_received:
        received.live_until_s = math.inf
    return all_received


@pytest.mark.usefixtures("_same_services")
def test_latency(speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latency, "NUM_REPEATS", 1)
    monkeypatch.setattr(latency, "speak", speak_without_deadline)
    monkeypatch.setattr(costs, "NUM_IMAGES", 3)
    monkeypatch.setattr(costs, "NUM_SESSIONS", (1,))
    small = [(name, detail, (64, 48), *rest) for name, detail, _, *rest in costs.CASES]
    monkeypatch.setattr(costs, "CASES", small)
    monkeypatch.setattr(page, "SIZE_PX", (320, 240))
    monkeypatch.setattr(page, "SETTLE_S", 0.5)
    monkeypatch.setattr(page, "MEASURE_S", 1.0)
    monkeypatch.setenv("KOUXING_SYNTHESIZER_DELAY_MS", "100")  # also for the services it starts
    figures = tmp_path / "latency.json"
    result = CliRunner().invoke(app, [str(speech), "--json", str(figures)])
    assert result.exit_code == 0, result.output
    written = json.loads(figures.read_text(encoding="utf-8"))
    assert written["num_frames"] > 0
    assert 0 < written["chunk_to_frame_ms"]["p50"] <= written["chunk_to_frame_ms"]["p95"]
    assert written["delay_ms"] == 100.0
    assert written["sound_to_frame_ms"]["p50"] > 0
    assert set(written["cpu_s_per_audio_s"]) >= {"recognizer", "synthesizer"}
    assert list(written["sessions"]) == [
        f"{name}, 1{lips}" for name in ("blocks", "light") for lips in ("", " with lips")
    ]
    assert all(cost > 0 for cost in written["sessions"].values())
    rendering = written["rendering"]
    assert all(rate > 0 for rate in rendering["images_per_s"].values())
    live, video = rendering["stages_ms"].values()
    assert list(live) == ["deform", "upload", "draw", "read back"]
    assert list(video) == [*live, "encode"]
    assert rendering["asset_bytes"] > 500_000
    drawings = written["page"]["drawings"]
    assert list(drawings) == ["idle", "microphone"]
    assert all("pictures_per_s" in drawing for drawing in drawings.values())
    assert f"{written['chunk_to_frame_ms']['p50']:.1f}" in result.stdout


@pytest.mark.usefixtures("_same_services")
def test_load_also_plots(speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "SETTLE_S", 1.0)
    figures, picture = tmp_path / "load.json", tmp_path / "load.png"
    arguments = ["load", str(speech), "--sessions", "2", "--seconds", "1", "--language", "auto"]
    result = CliRunner().invoke(
        app, [*arguments, "--json", str(figures), "--picture", str(picture)]
    )
    assert result.exit_code == 0, result.output
    written = json.loads(figures.read_text(encoding="utf-8"))
    assert [step["num_asked"] for step in written["steps"]] == [1, 2]
    for step in written["steps"]:
        assert step["num_sessions"] + sum(step["refusals"].values()) == step["num_asked"]
        assert 0 < step["delay_ms"]["p50"] <= step["delay_ms"]["p95"]
        assert set(step["cpu_cores"]) == {*KINDS, "client"}
        assert step["memory_mb"]["recognizer"] > 50
    assert format_figure(written["steps"][0]["delay_ms"]["p50"]) in result.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("_same_services")
def test_busy(speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def _run(lateness_s: list[tuple[float, float]], load_s: float) -> BusyRun:
    """Make a run from pairs of a duration and its lateness."""
    values = [late for lasts_s, late in lateness_s for _ in range(round(lasts_s / STEP_S))]
    return BusyRun(
        num_programs=1, quiet_median_s=0.1, lateness_s=values, load_s=load_s, missing=0.0
    )


def test_the_summary_of_busy_has_worst_lateness_and_recovery_time() -> None:
    run = _run([(1.0, 0.0), (0.5, 0.4), (0.1, 0.2), (0.7, 0.6), (0.7, 0.1), (2.0, 0.04)], 2.0)
    assert run.worst_s == 0.6
    assert run.longest_s == pytest.approx(0.7)
    assert run.recovery_s == pytest.approx(1.0)
    assert _run([(5.0, 0.1)], 2.0).recovery_s is None
