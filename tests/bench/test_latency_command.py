"""The bench command prints and writes its figures."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.system.commands import app
from kouxing.evaluation.system.costs import CASES


def test_the_command_prints_and_writes_the_same_figures(
    speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kouxing.evaluation.system.latency.NUM_REPEATS", 1)
    monkeypatch.setattr("kouxing.evaluation.system.costs.NUM_IMAGES", 3)
    monkeypatch.setattr("kouxing.evaluation.system.costs.NUM_SESSIONS", (1,))
    small = [(name, detail, (64, 48), *rest) for name, detail, _, *rest in CASES]
    monkeypatch.setattr("kouxing.evaluation.system.costs.CASES", small)
    monkeypatch.setattr("kouxing.evaluation.system.page.SIZE_PX", (320, 240))
    monkeypatch.setattr("kouxing.evaluation.system.page.SETTLE_S", 0.5)
    monkeypatch.setattr("kouxing.evaluation.system.page.MEASURE_S", 1.0)
    monkeypatch.setenv("KOUXING_SYNTHESIZER_DELAY_MS", "100")  # also for the started services
    figures = tmp_path / "latency.json"
    arguments = [str(speech), "--json", str(figures)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    latency = json.loads(figures.read_text(encoding="utf-8"))
    assert latency["num_frames"] > 0
    assert 0 < latency["chunk_to_frame_ms"]["p50"] <= latency["chunk_to_frame_ms"]["p95"]
    assert latency["delay_ms"] == 100.0
    assert latency["sound_to_frame_ms"]["p50"] > 0
    assert set(latency["cpu_s_per_audio_s"]) >= {"recognizer", "synthesizer"}
    assert list(latency["sessions"]) == [
        f"{name}, 1{lips}" for name in ("blocks", "light") for lips in ("", " with lips")
    ]
    assert all(cost > 0 for cost in latency["sessions"].values())
    rendering = latency["rendering"]
    assert all(rate > 0 for rate in rendering["images_per_s"].values())
    live, video = rendering["stages_ms"].values()
    assert list(live) == ["deform", "upload", "draw", "read back"]
    assert list(video) == [*live, "encode"]
    assert rendering["asset_bytes"] > 500_000
    drawings = latency["page"]["drawings"]
    assert list(drawings) == ["idle", "microphone"]
    assert all("pictures_per_s" in drawing for drawing in drawings.values())
    assert f"{latency['chunk_to_frame_ms']['p50']:.1f}" in result.stdout
