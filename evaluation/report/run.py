"""Runs the steps of the report that are out of date, and stores their results.

A result is a JSON file with the commands, machine, date, commit and load. It is out of date if the
commands, or the hash of the code and models that its step depends on, have changed.
"""

import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from kouxing.evaluation.report.code_hash import code_hash
from kouxing.evaluation.report.steps import FOLDER_OPTIONS, STEPS
from kouxing.evaluation.source_tree import ROOT
from kouxing.shared.command.terminal import print_message

_OMITTED_KEYS = {
    "rules",
    "lateness_s",
    "errors_by_recording",
    "phone_errors_by_speaker",
    "viseme_errors_by_speaker",
}
_OMITTED_GROUPS = ("source ", "speaker ")
_DIGITS = 5
# The report itself writes these files, so their changes do not make a commit dirty.
_REPORT_FILES = (":!docs/results", ":!docs/results.md", ":!docs/*.png")


def run_steps(
    names: Iterable[str],
    folders: Mapping[str, Path | None],
    results: Path,
    *,
    is_quick: bool,
    is_fresh: bool,
) -> list[str]:
    """Run steps and return those that failed.

    ``folders`` are the data folders that the commands use. A step without its data is skipped.
    """
    failed = []
    for name in names:
        step, path = STEPS[name], results / f"{name}.json"
        commands = step.commands if step.quick is None or not is_quick else step.quick
        if reason := _reason_to_skip(commands, folders):
            print_message(f"{name}: skipped ({reason})")
            continue
        command_lines = [re.sub("[{}]", "", f"kouxing {command}") for command in commands]
        code = code_hash(step.code)
        if not is_fresh and _is_up_to_date(path, command_lines, code):
            print_message(f"{name}: up to date")
            continue
        print_message(f"{name}: {command_lines[-1]}")
        measured = describe_run()
        figures = _run(commands, folders)
        if figures is None:
            failed.append(name)
        else:
            write_result(path, {"commands": command_lines, **measured, "code": code, **figures})
    return failed


def _reason_to_skip(commands: Sequence[str], folders: Mapping[str, Path | None]) -> str:
    """Return why a step cannot run; empty if it can."""
    if not commands:
        return "it is not part of a quick report"
    for key, folder in folders.items():
        if folder is None and f"{{{key}}}" in str(commands):
            return f"add {FOLDER_OPTIONS[key]}"
    return ""


def _is_up_to_date(path: Path, commands: list[str], code: str) -> bool:
    stored = json.loads(path.read_text("utf-8")) if path.exists() else {}
    return bool(stored) and (stored["commands"], stored["code"]) == (commands, code)


def describe_run() -> dict[str, Any]:
    """Return machine, date and commit."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text(encoding="utf-8").splitlines() if cpu.exists() else []
    models = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
    commit = _git("describe", "--always")
    if commit and _git("status", "--porcelain", "--untracked-files=no", "--", ".", *_REPORT_FILES):
        commit += "-dirty"
    return {
        "machine": f"{models[0] if models else platform.processor()}, {os.cpu_count()} cores",
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "commit": commit or "unknown",
    }


def _git(*arguments: str) -> str:
    """Return the output of a git command; empty outside a repository."""
    done = subprocess.run(  # noqa: S603
        ["git", *arguments],  # noqa: S607
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip()


def write_result(path: Path, result: Mapping[str, Any]) -> None:
    """Write a result rounded to five digits, without figures by speaker, recording and frame."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_to_json(_trim_figures(result)) + "\n", encoding="utf-8")


def _run(commands: Iterable[str], folders: Mapping[str, Path | None]) -> dict[str, Any] | None:
    *earlier, last = commands
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "result.json"
        load, start_s, start_cpu_s = os.getloadavg()[0], time.monotonic(), _cpu_s()
        for command in (*earlier, f"{last} --json {path}"):
            arguments = command.format_map(folders).split()
            done = subprocess.run(  # noqa: S603
                [sys.executable, "-m", "kouxing", *arguments], cwd=ROOT, check=False
            )
            if done.returncode:
                return None
        return {
            "load": load,
            "seconds": round(time.monotonic() - start_s),
            "cpu_seconds": round(_cpu_s() - start_cpu_s),
            "result": json.loads(path.read_text("utf-8")),
        }


def _cpu_s() -> float:
    """Return the processor time of all finished child processes, seconds."""
    times = os.times()
    return times.children_user + times.children_system


def _to_json(value: Any, indent: str = "") -> str:
    """Return JSON with a line for each object or list that contains no others."""
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if not any(isinstance(item, dict | list) for item in items):
        return json.dumps(value, ensure_ascii=False)
    inner = f"{indent} "
    if isinstance(value, list):
        lines = [inner + _to_json(item, inner) for item in value]
    else:
        lines = [f"{inner}{json.dumps(key)}: {_to_json(value[key], inner)}" for key in value]
    start, end = "[]" if isinstance(value, list) else "{}"
    return "\n".join([start, ",\n".join(lines), indent + end])


def _trim_figures(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            key: _trim_figures(item)
            for key, item in value.items()
            if key not in _OMITTED_KEYS and not key.startswith(_OMITTED_GROUPS)
        }
    if isinstance(value, list | tuple):
        return [_trim_figures(item) for item in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value
