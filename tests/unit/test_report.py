"""The report: which steps run, what their files contain, and the page that they make."""

import json
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from kouxing.evaluation.commands import app
from kouxing.evaluation.report import lip_tables, recognition_table, run, system_tables
from kouxing.evaluation.report.code_hash import code_hash
from kouxing.evaluation.report.markdown import markdown
from kouxing.evaluation.report.page import TABLES, write_page
from kouxing.evaluation.report.run import run_steps, write_result
from kouxing.evaluation.report.steps import ROOT, STEPS, Step
from kouxing.evaluation.system.busy import Run
from kouxing.evaluation.system.continuity import Continuity
from kouxing.evaluation.system.faults import Outcome
from kouxing.evaluation.system.latency import Latency
from kouxing.evaluation.system.lips_page import LipsPage
from kouxing.evaluation.system.page import Drawing
from kouxing.shared.errors import UserError

SCORES = {"r_opening": 0.5, "closure_f1": 0.6, "mtm_ms": 50.0, "slcc": 0.0}
SCORES |= {"closure_precision": 0.5, "closure_recall": 0.75}
BETTER = {"r_opening": 0.7, "closure_f1": 0.4, "mtm_ms": 40.0, "slcc": 0.2}
BETTER |= {"closure_precision": 1.0, "closure_recall": 0.25}


def faces(**by_title: dict[str, float]) -> dict[str, Any]:
    return {title: {"clean": {"all": scores}} for title, scores in by_title.items()}


def rivals() -> dict[str, Any]:
    return faces(real={"slcc": 0.3}) | {
        "learnt, 60 ms": {"clean": {"all": SCORES}},
        "wawa, fitted, 100 ms": {"clean": {"all": BETTER}},
        "dynamic-visemes, 160 ms": {"clean": {"all": BETTER | {"r_opening": 0.9}}},
    }


def step_file(result: Any) -> dict[str, Any]:
    about = {"machine": "m", "date": "2026-01-01", "commit": "c", "load": 0.5}
    time = {"seconds": 3, "cpu_seconds": 2}
    return {"commands": ["kouxing x"], **about, **time, "code": "1", "result": result}


def test_every_step_names_code_that_exists_and_a_command() -> None:
    for step in STEPS.values():
        assert all([*ROOT.glob(pattern)] for pattern in step.code)
        for command in (*step.commands, *(step.quick or ())):
            group = {"evaluate": app}.get(command.split()[0])
            assert group is None or command.split()[1] in {
                c.name or c.callback.__name__ for c in group.registered_commands if c.callback
            }
    assert {name for part in TABLES.values() for name in part.steps} | {"lips"} == {*STEPS}


def test_a_step_runs_only_if_its_code_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashes = ["1", "1", "1", "2", "2"]
    monkeypatch.setattr(f"{run.__name__}.code_hash", lambda _: hashes.pop(0))
    monkeypatch.setitem(STEPS, "mine", Step(("bench {data}",), ("code.py",)))
    commands: list[list[str]] = []

    def measure(command: list[str], **_: object) -> Any:
        commands.append(command)
        if "--json" in command:
            Path(command[-1]).write_text(json.dumps({"r": 0.123456789, "speaker ann": 1}))
        is_clean = "status" in command and ":!docs/results" in command
        return type("Done", (), {"returncode": 0, "stdout": "" if is_clean else "abc"})

    monkeypatch.setattr("subprocess.run", measure)
    options = {"is_quick": False, "is_fresh": False}

    def run_mine(**changed: Any) -> int:
        commands.clear()
        assert run_steps(["mine"], {"data": Path("/d")}, tmp_path, **options | changed) == []
        return sum(sys.executable in command for command in commands)

    assert run_mine() == 1
    assert ["kouxing", "bench", "/d"] in [command[2:5] for command in commands]
    stored = json.loads((tmp_path / "mine.json").read_text())
    assert stored["result"] == {"r": 0.12346}
    assert stored["commands"] == ["kouxing bench data"]
    assert stored["commit"] == "abc"
    assert run_mine() == 0
    assert run_mine(is_fresh=True) == 1
    assert run_mine() == 1  # the code has changed
    assert run_steps(["mine"], {"data": None}, tmp_path, **options) == []  # left out without data


@pytest.mark.parametrize(
    ("name", "content", "is_changed"),
    [
        ("corpora/used.py", '"""Other words."""\n\nX = 1  # a comment\n', False),
        ("corpora/used.py", "X = 2\n", True),
        ("corpora/unused.py", "X = 2\n", False),
        ("data/model.npz", "2", True),
        ("data/README.md", "2", False),
        ("data/node_modules/a.js", "2", False),
    ],
)
def test_the_hash_of_code_changes_with_what_runs(
    tmp_path: Path, name: str, content: str, is_changed: bool
) -> None:
    files = {
        "measure.py": "from kouxing.corpora.used import X\n",
        "corpora/used.py": '"""Words."""\nX = 1\n',
        "corpora/unused.py": "X = 1\n",
        "data/model.npz": "1",
        "data/README.md": "1",
        "data/node_modules/a.js": "1",
    }
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    before = code_hash(("*.py", "data"), tmp_path)
    (tmp_path / name).write_text(content, encoding="utf-8")
    assert (code_hash(("*.py", "data"), tmp_path) != before) is is_changed


def test_a_result_has_a_line_for_each_record(tmp_path: Path) -> None:
    write_result(tmp_path / "x.json", {"load": 1, "result": {"a": {"r": 0.5, "n": 2}, "b": [1, 2]}})
    assert (tmp_path / "x.json").read_text("utf-8").splitlines() == [
        "{",
        ' "load": 1,',
        ' "result": {',
        '  "a": {"r": 0.5, "n": 2},',
        '  "b": [1, 2]',
        " }",
        "}",
    ]


def test_a_failed_step_is_reported_and_leaves_the_old_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_result(tmp_path / "sizes.json", step_file({"old": 1}))
    failed = type("Done", (), {"returncode": 1, "stdout": ""})
    monkeypatch.setattr("subprocess.run", lambda *_, **__: failed)
    assert run_steps(["sizes"], {}, tmp_path, is_quick=False, is_fresh=False) == ["sizes"]
    assert json.loads((tmp_path / "sizes.json").read_text())["result"] == {"old": 1}


def test_an_unknown_step_is_an_error() -> None:
    with pytest.raises(UserError, match="no step 'fautls'; choose from read,"):
        CliRunner().invoke(app, ["report", "fautls"], catch_exceptions=False)


def test_the_page_starts_with_what_others_do_better() -> None:
    assert lip_tables.better_programs({"rivals": rivals()}) == [
        "all clips, correlation of the opening: wawa-lipsync 0.0.2, fitted, 100 ms (0.70);"
        " learnt, 60 ms (0.50)",
        "all clips, precision of closures: wawa-lipsync 0.0.2, fitted, 100 ms (1.00, recall 0.25);"
        " learnt, 60 ms (0.50, recall 0.75)",
        "all clips, MTM: wawa-lipsync 0.0.2, fitted, 100 ms (40 ms); learnt, 60 ms (50 ms)",
        "all clips, SLCC: wawa-lipsync 0.0.2, fitted, 100 ms (0.20); learnt, 60 ms (0.00,"
        " real lips 0.30)",
    ]


def test_the_page_has_a_table_for_each_measured_part(tmp_path: Path) -> None:
    results = {
        "rivals": rivals(),
        "lookahead": faces(**{"learnt, 0 ms": SCORES, "learnt, 60 ms": BETTER}),
        "read": {},
    }
    for name, result in results.items():
        write_result(tmp_path / "results" / f"{name}.json", step_file(result))
    page = tmp_path / "results.md"
    write_page(tmp_path / "results", page)
    text = page.read_text("utf-8")
    assert "[[" not in text
    assert "| **learnt**, 60 ms |" in text
    assert "| learnt, r | 0.50 | 0.70 |" in text
    assert "| floor of the latency, ms | 37 | 97 |" in text
    assert "`kouxing x`: m, 2026-01-01, commit c, 3 s (2 s of processor time), load 0.5" in text
    assert 'make report STEPS="faults"' in text
    assert '- Not measured yet: `make report STEPS="conversation disturbed languages"`' in text


def test_the_table_of_languages_has_a_row_per_recognizer() -> None:
    def score(feature: float, **more: Any) -> dict[str, Any]:
        rates = {"phone": 0.3, "viseme": 0.2, "feature": feature}
        final: dict[str, Any] = {f"{unit}_error_rate": rate for unit, rate in rates.items()}
        final |= {"phone_errors": {"reference": 9}, "labials": {"recall": 1.0, "precision": 0.5}}
        return {"speech": {"language en-GRID": {"final": final, **more}}}

    live = {"first": {"phone_error_rate": 0.4, "viseme_error_rate": 0.3}, "delay_ms": {"p50": 90.0}}
    languages = {"own": score(0.1, **live), "hama": score(0.05)}
    results = {"languages": languages}
    own, hama = recognition_table.recognition(results)[1][:2]
    assert own[:4] == ["English, GRID", "the language's own phones", "9", "30.0 / 20.0 / 10.0"]
    assert own[4:] == ["40.0 / 30.0", "90 / -", "100 / 50"]
    assert hama[1:] == ["hama 1.7.0, offline", "9", "30.0 / 20.0 / 5.0", "-", "- / -", "100 / 50"]
    assert recognition_table.better_recognizers(results) == [
        "English, GRID, errors of features: hama 1.7.0, offline (5.0 %); kouxing, live (10.0 %)"
    ]


def test_writes_a_markdown_table() -> None:
    assert markdown((("a", "b"), [["1", "2"]])) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_the_system_table_reads_what_the_commands_write() -> None:
    page = LipsPage(
        name="kouxing-lips",
        download_bytes=4_600_000,
        loaded_ms=600.0,
        first_movement_ms=1300.0,
        delay_ms={"p50": 79.0, "p95": 90.0},
        processor_share=0.08,
        page_share=0.05,
        num_clips=57,
        lag_ms=110.0,
        opening_correlation=0.6,
        closure_f1=0.65,
    )
    other = replace(page, name="HeadAudio", download_bytes=100_000, delay_ms=None)
    values: dict[str, Any] = dict.fromkeys((field.name for field in fields(Drawing)), 1.0)
    drawing = Drawing(**values | {"pictures_per_s": 20.0, "voice_to_picture_ms": 140.0})
    latency = Latency(
        chunk_to_frame_ms={"p50": 4.9, "p95": 9.2},
        sound_to_frame_ms={"p50": 65.0, "p95": 69.0},
        delay_ms=60.0,
        num_frames=100,
        cpu_s_per_audio_s={"recognizer": 0.2, "synthesizer": 0.1},
    )
    results = {
        "chain": asdict(latency) | {"page": {"drawings": {"microphone": asdict(drawing)}}},
        "load": {"cores": 2, "summary": {"sessions": 15.0}},
        "busy": {
            "runs": [{"num_programs": 2}],
            "summary": [{"worst_s": 0.04, "missing": 0.01}],
        },
        "browser": asdict(page) | {"others": [asdict(other)]},
        "sizes": {
            "model_bytes": {"encoder": 2_400_000},
            "frame_bytes": 369,
            "floor_cores": {"hop 1": 0.1, "hop 4": 0.04},
        },
    }
    rows = {row[0]: row[1:3] for row in system_tables.system(results)[1]}
    assert rows["end of a chunk to its frame, p50 / p95, ms"] == ["4.9 / 9.2", "0"]
    assert rows["processor time of all services, s per s of audio"] == ["0.30", "0.10"]
    assert rows["page in headless Chromium, microphone, pictures per s"] == ["20", "60"]
    assert rows["sound to its image on the page, ms"] == ["140", "97"]
    assert rows["sessions on 2 cores, all speaking"] == ["15", "50"]
    assert rows["2 busy programs: largest lateness, s / frames missing, %"] == ["0.04 / 1", "0"]
    assert rows["kouxing-lips in the browser: download, MB / share of a core, %"] == [
        "4.6 / 8",
        "2.4 / -",
    ]
    assert "HeadAudio in the browser: download, MB / share of a core, %" in rows
    accuracy = "kouxing-lips in the browser: lag, ms / correlation of the opening / F1 of closures"
    assert rows[accuracy][0] == "110 / 0.60 / 0.65"
    assert rows["the page itself, included in these shares: share of a core, %"][0] == "5"
    assert system_tables.better_packages(results) == [
        "browser, download: HeadAudio (0.1 MB); kouxing-lips (4.6 MB)"
    ]
    assert system_tables.better_packages({}) == []


def test_the_table_of_faults_reads_a_stored_result(tmp_path: Path) -> None:
    values: dict[str, Any] = dict.fromkeys((field.name for field in fields(Continuity)), 0)
    face = Continuity(**values | {"stood_s": 0.5, "late_s": 0.25, "largest_step": 1.2})
    killed = Outcome(fault="control killed", failure="", face=face, late_p95_ms=15.4, load=1.0)
    write_result(tmp_path / "faults.json", step_file([asdict(killed)]))
    stored = json.loads((tmp_path / "faults.json").read_text("utf-8"))
    (row,) = system_tables.faults({"faults": stored["result"]})[1]
    assert row == ["control killed", "0.50", "0.25", "0", "0 / 0 / 0", "1.2", "15", "0"]


def test_the_lateness_of_each_frame_is_not_stored(tmp_path: Path) -> None:
    run = Run(num_programs=2, quiet_median_s=0.1, lateness_s=[0.0, 0.2], load_s=1.0, missing=0.0)
    write_result(tmp_path / "busy.json", step_file({"runs": [asdict(run)]}))
    stored = json.loads((tmp_path / "busy.json").read_text("utf-8"))
    assert [*stored["result"]["runs"][0]] == ["num_programs", "quiet_median_s", "load_s", "missing"]
