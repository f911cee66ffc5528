"""Commands find the running system of their user."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from kouxing.services.cli.clients import control_address
from kouxing.services.cli.running_system import announce, find_control
from kouxing.shared.keys import user_key
from tests.system import ROOT

ANNOUNCE = """
import sys
from kouxing.services.cli.running_system import announce
with announce(sys.argv[1]):
    print("announced", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("KOUXING_CONTROL", raising=False)


def announcing(control: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", ANNOUNCE, control],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "announced\n"
    return process


def test_finds_the_newest_running_system_even_if_others_were_killed() -> None:
    assert find_control() == ""
    first, second, third = (announcing(f"tcp://127.0.0.1:{port}") for port in (1, 2, 3))
    assert find_control() == "tcp://127.0.0.1:3"
    third.kill()  # leaves its file behind
    third.communicate()
    assert find_control() == "tcp://127.0.0.1:2"
    second.communicate()  # the end of its input
    assert control_address("") == "tcp://127.0.0.1:1"
    first.communicate()
    assert find_control() == ""


def test_a_given_address_overrides_the_running_system(monkeypatch: pytest.MonkeyPatch) -> None:
    with announce("tcp://127.0.0.1:1"):
        assert control_address("") == "tcp://127.0.0.1:1"
        key = user_key().control
        assert control_address("tcp://127.0.0.1:4") == f"tcp://127.0.0.1:4 {key}"
        monkeypatch.setenv("KOUXING_CONTROL", "tcp://127.0.0.1:5")
        assert control_address("") == f"tcp://127.0.0.1:5 {key}"
        monkeypatch.setenv("KOUXING_INSECURE", "true")
        assert control_address("") == "tcp://127.0.0.1:5"


def test_ignores_a_folder_that_others_can_write_to(tmp_path: Path) -> None:
    with announce("tcp://127.0.0.1:1"):
        (folder,) = tmp_path.iterdir()
        folder.chmod(0o777)
        assert find_control() == ""
