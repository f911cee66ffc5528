"""The figures of the load benchmark, without sockets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar, cast

import pytest
from kouxing_client import Session
from typer.testing import CliRunner

from kouxing.evaluation.commands import bench_app
from kouxing.evaluation.system import latency
from kouxing.evaluation.system.load import Load, Spoken, Step


class _Session:
    info: ClassVar = {"facts": {"frame_rate_hz": 50.0}}


def _spoken(arrived_s: dict[int, float]) -> Spoken:
    return Spoken(cast(Session, _Session()), b"", start_s=100.0, arrived_s=arrived_s)


def test_a_frame_is_due_with_its_last_chunk() -> None:
    # with a delay of 60 ms the frame at 20 ms needs 80 ms of sound: due at 100.08 s
    spoken = _spoken({0: 100.065, 320: 100.090})
    assert list(spoken.delays_s(0.06, 100.0, 100.085)) == pytest.approx([0.005, 0.005])


def test_missing_frames_count_as_late() -> None:
    assert list(_spoken({0: 100.065}).delays_s(0.06, 100.07, 100.2)) == pytest.approx(
        [0.12, 0.10, 0.08, 0.06, 0.04, 0.02], abs=1e-6
    )


def _step(number: int, worst_p95_ms: float) -> Step:
    return Step(
        num_asked=number,
        num_sessions=number,
        refusals={},
        delay_ms={"p50": 5.0, "p95": worst_p95_ms},
        worst_p95_ms=worst_p95_ms,
        num_rest_frames=0,
        cpu_cores={"recognizer": 0.1 * number, "synthesizer": 0.0},
        memory_mb={"recognizer": 100.0 + 3 * number, "synthesizer": 50.0},
        client_late_ms=0.0,
        client_cpu_cores=0.1,
    )


def test_summarizes_the_best_step() -> None:
    refused = replace(_step(12, 20.0), num_asked=16, refusals={"busy": 4})
    load = Load([_step(1, 5.0), _step(8, 10.0), refused, _step(20, 900.0)], 2, 0.0, 60.0)
    assert load.summary == pytest.approx(
        {
            "sessions": 12,
            "sessions_per_core": 6,
            "sessions_per_busy_core": 10,
            "recognizer_mb_per_session": 3,
            "synthesizer_mb_per_session": 0,
        }
    )
    assert Load([_step(1, 61.0)], 2, 0.0, 60.0).summary == {"sessions": 0}


def test_bench_with_a_file_measures_the_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[tuple[Path, int]] = []

    def measure(path: Path, repeats: int, _console: object) -> None:
        measured.append((path, repeats))
        raise SystemExit(3)

    monkeypatch.setattr(latency, "measure", measure)
    for arguments in (["my.wav", "--repeats", "2"], ["--repeats", "2", "my.wav"]):
        assert CliRunner().invoke(bench_app, arguments).exit_code == 3
    assert measured == [(Path("my.wav"), 2)] * 2
    assert "load" in CliRunner().invoke(bench_app, ["--help"]).output
