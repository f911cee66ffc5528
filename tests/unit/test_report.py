"""The report: which steps run, what their files contain, and the page that they make."""

import json
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from kouxing.evaluation.commands import app
from kouxing.evaluation.report import run
from kouxing.evaluation.report.code_hash import code_hash
from kouxing.evaluation.report.page import TABLES
from kouxing.evaluation.report.run import run_steps, write_result
from kouxing.evaluation.report.steps import STEPS, Step
from kouxing.evaluation.report.system_tables import attacks_table, faults_table
from kouxing.evaluation.source_tree import ROOT
from kouxing.evaluation.system.commands import app as bench_app
from kouxing.evaluation.system.continuity import Continuity
from kouxing.evaluation.system.faults import FaultOutcome
from kouxing.shared.errors import UserError

SCORES = {"r_opening": 0.5, "closure_f1": 0.6, "mtm_ms": 50.0, "slcc": 0.0}
SCORES |= {"closure_precision": 0.5, "closure_recall": 0.75}
BETTER = {"r_opening": 0.7, "closure_f1": 0.4, "mtm_ms": 40.0, "slcc": 0.2}
BETTER |= {"closure_precision": 1.0, "closure_recall": 0.25}


def step_file(result: Any) -> dict[str, Any]:
    about = {"machine": "m", "date": "2026-01-01", "commit": "c", "load": 0.5}
    time = {"seconds": 3, "cpu_seconds": 2}
    return {"commands": ["kouxing x"], **about, **time, "code": "1", "result": result}


def test_every_step_names_code_a_command_and_options_that_exist() -> None:
    groups = {"evaluate": get_command(app), "bench": get_command(bench_app)}
    for step in STEPS.values():
        assert all([*ROOT.glob(pattern)] for pattern in step.code)
        for command in (*step.commands, *(step.quick or ())):
            group, name, *words = command.split()
            parameters = groups[group].commands[name].params  # type: ignore[attr-defined]
            known = {option for parameter in parameters for option in parameter.opts}
            assert {word for word in words if word.startswith("--")} <= known
    assert {name for shown, _ in TABLES.values() for name in shown} | {"lips"} == {*STEPS}


def test_a_step_runs_only_if_its_code_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashes = ["1", "1", "1", "2", "2"]
    monkeypatch.setattr(f"{run.__name__}.code_hash", lambda _: hashes.pop(0))
    monkeypatch.setitem(STEPS, "mine", Step(("bench {corpus}",), ("code.py",)))
    commands: list[list[str]] = []

    def measure(command: list[str], **_: object) -> Any:
        commands.append(command)
        if "--json" in command:
            Path(command[-1]).write_text(json.dumps({"r": 0.123456789, "speaker ann": 1}))
        is_clean = "status" in command and ":!docs/results" in command
        return type("Done", (), {"returncode": 0, "stdout": "" if is_clean else "abc"})

    monkeypatch.setattr("subprocess.run", measure)
    options = {"is_quick": False, "is_fresh": False}

    def run_step(**changed: Any) -> int:
        commands.clear()
        assert run_steps(["mine"], {"corpus": Path("/d")}, tmp_path, **options | changed) == []
        return sum(sys.executable in command for command in commands)

    assert run_step() == 1
    assert ["kouxing", "bench", "/d"] in [command[2:5] for command in commands]
    stored = json.loads((tmp_path / "mine.json").read_text())
    assert stored["result"] == {"r": 0.12346}
    assert stored["commands"] == ["kouxing bench corpus"]
    assert stored["commit"] == "abc"
    assert run_step() == 0
    assert run_step(is_fresh=True) == 1
    assert run_step() == 1  # the code has changed
    assert run_steps(["mine"], {"corpus": None}, tmp_path, **options) == []  # left out without data


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


def test_the_table_of_attacks_has_the_service_that_grew_most() -> None:
    result = {
        "attack": "random bytes",
        "target": "audio",
        "has_key": False,
        "growth_mb": {"control": 0.5, "recognizer": 2.0},
        "kept_mb": {"control": 0.4, "recognizer": 1.0},
        "restarted": ["gateway"],
        "p95_ms": {"before": 8.0, "during": 12.0, "after": None},
    }
    (row,) = attacks_table([result]).rows
    assert row[:3] == ["random bytes; gateway restarted", "audio", "no"]
    assert row[3:] == ["recognizer", "2.0", "1.0", "8 / 12 / -"]


def test_the_table_of_faults_says_which_sessions_did_not_complete() -> None:
    face = Continuity(**{field.name: 2 for field in fields(Continuity)})
    outcomes = [
        FaultOutcome(fault="killed", failure="no last frame", face=face, load=0.5),
        FaultOutcome(fault="gone", failure="no last frame", load=0.5),
        FaultOutcome(fault="none", failure="", face=face, load=0.5),
    ]
    killed, gone, none = faults_table([asdict(outcome) for outcome in outcomes]).rows
    assert (killed[0], killed[3:5]) == ("killed; not completed: no last frame", ["2", "2 / 2 / 2"])
    assert (gone[0], gone[1:5]) == ("gone; not completed: no last frame", ["-"] * 4)
    assert none[0] == "none"
