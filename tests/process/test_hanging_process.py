"""A service that hangs is told from one that gets no processor, or waits."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from kouxing.services.cli.service_process import LOOK_S, SILENT_S, WORKED_S, ServiceProcess
from kouxing.shared.client import Client
from kouxing.shared.keys import control_endpoint
from tests.system import PATIENT, own_addresses

pytestmark = pytest.mark.process
WAITS_S = 2.0
BLOWS = f"""
import signal, time
def spin(*_):
    while True:
        pass
signal.signal(signal.SIGUSR1, spin)
signal.signal(signal.SIGUSR2, lambda *_: time.sleep({WAITS_S}))
"""


@pytest.fixture
def control(tmp_path: Path) -> Iterator[ServiceProcess]:
    (tmp_path / "sitecustomize.py").write_text(BLOWS, encoding="utf-8")
    addresses = own_addresses(["control"])
    environment = {**os.environ, **PATIENT, **addresses, "PYTHONPATH": str(tmp_path)}
    process = ServiceProcess("control", environment=environment)
    with process, Client(control_endpoint(addresses["KOUXING_CONTROL"], insecure=False)) as client:
        client.status()
        yield process
        process.kill()


def hangs_within(process: ServiceProcess, limit_s: float) -> bool:
    """Look at a process for some time; return whether it hung at one of the looks."""
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        if process.hangs(WORKED_S):
            return True
        time.sleep(LOOK_S)
    return False


@pytest.mark.parametrize("blow", [signal.SIGSTOP, signal.SIGUSR1], ids=["stopped", "spins"])
def test_one_that_is_stopped_or_spins_hangs(control: ServiceProcess, blow: signal.Signals) -> None:
    assert not hangs_within(control, 1.0)
    control.send_signal(blow)
    assert hangs_within(control, 60.0)


def test_one_that_waits_does_not(control: ServiceProcess) -> None:
    assert not hangs_within(control, 2 * LOOK_S)
    control.send_signal(signal.SIGUSR2)
    assert WAITS_S > SILENT_S
    assert not hangs_within(control, WAITS_S + 1.0)


def test_what_this_process_missed_does_not_count(control: ServiceProcess) -> None:
    assert not control.hangs(WORKED_S)
    control.send_signal(signal.SIGSTOP)
    time.sleep(2 * SILENT_S)
    assert not control.hangs(WORKED_S), "its heartbeats may wait"
    assert not control.hangs(WORKED_S)
