"""A process stands by with its libraries loaded, and becomes the service that crashes."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from rich.console import Console

from kouxing.services.cli import supervisor as supervisors
from kouxing.services.cli.supervisor import Supervisor
from kouxing.shared.client import Client
from kouxing.shared.keys import control_endpoint
from tests.system import own_addresses

pytestmark = pytest.mark.process


def standing_by() -> list[int]:
    """Return the numbers of the processes of this one that stand by."""
    lists = [each.read_text("ascii") for each in Path("/proc/self/task").glob("*/children")]
    numbers = map(int, " ".join(lists).split())
    return [each for each in numbers if b"standby" in command_of(each)]


def command_of(number: int) -> bytes:
    """Return what a process was started with, nothing if it has ended."""
    try:
        return Path(f"/proc/{number}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


@pytest.mark.timeout(120)
def test_it_becomes_a_service_that_crashed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisors, "STANDBY_S", 0.0)
    environment = own_addresses(["control"])
    control = control_endpoint(environment["KOUXING_CONTROL"], insecure=False)
    supervisor = Supervisor([], tmp_path, Console(quiet=True), environment, services=["control"])
    try:
        supervisor.start()
        supervisor.wait_ready(control)
        supervisor.watch()
        while not standing_by():
            time.sleep(0.05)
        (number,) = standing_by()
        os.kill(supervisor.process_number("control"), signal.SIGKILL)
        while len(standing_by()) < 2:  # the next one does
            time.sleep(0.05)
        assert supervisor.process_number("control") == number
        with Client(control, deadline_s=60.0) as client:
            assert client.status().sessions == []
    finally:
        supervisor.stop()
