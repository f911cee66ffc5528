"""A service process: SIGTERM ends it with status 0, a wrong configuration with status 2."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from kouxing.services.kinds import KINDS
from kouxing.shared.config import variable
from tests.system import ROOT, System, own_addresses

pytestmark = pytest.mark.process


def ended(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        env={**os.environ, **environment},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_every_service_stops_cleanly_on_sigterm(tmp_path: Path) -> None:
    with System(("control", "recognizer", "synthesizer", "driver"), tmp_path) as system:
        processes = dict(system.processes)
        for process in processes.values():
            process.send_signal(signal.SIGTERM)
        statuses = {service: process.wait(60) for service, process in processes.items()}
    assert statuses == dict.fromkeys(processes, 0)
    for service in processes:
        assert '"message": "stopped"' in system.log(service)
        assert "traceback" not in system.log(service).lower()


def test_ctrl_c_during_startup_prints_no_traceback() -> None:
    addresses = own_addresses(["recognizer"])
    port = int(addresses[variable("recognizer", "audio")].rpartition(":")[2])
    process = subprocess.Popen(
        [sys.executable, "-m", "kouxing.services.recognizer"],
        env={**os.environ, **addresses},
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    end_s = time.monotonic() + 60
    with socket.socket() as probe:
        while probe.connect_ex(("127.0.0.1", port)) != 0:  # bound, but no model is loaded yet
            assert time.monotonic() < end_s
            time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, log = process.communicate(timeout=60)
    assert process.returncode in (-signal.SIGINT, 0)
    assert "Traceback" not in log


@pytest.mark.parametrize(
    ("module", "slow_import"), [("kouxing.services.recognizer", "pydantic"), ("kouxing", "typer")]
)
def test_ctrl_c_in_imports_prints_nothing(tmp_path: Path, module: str, slow_import: str) -> None:
    ctrl_c = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
    (tmp_path / f"{slow_import}.py").write_text(ctrl_c)
    result = ended(module, PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}")
    assert result.returncode == -signal.SIGINT
    assert result.stderr == ""


@pytest.mark.parametrize(
    ("service", "key"),
    [("control", "control"), ("recognizer", "audio"), ("synthesizer", "phone_input")],
)
def test_reports_a_port_in_use(service: str, key: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        setting = {variable(service, key): f"tcp://127.0.0.1:{taken.getsockname()[1]}"}
        result = ended(f"kouxing.services.{service}", **setting)
    assert result.returncode == 2
    assert f"{service}.{key}" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("service", KINDS)
def test_reports_a_wrong_setting_before_it_binds_anything(service: str) -> None:
    result = ended(f"kouxing.services.{service}", "--set", "log_level=loud")
    assert result.returncode == 2
    assert f"{service}.log_level" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_service_ends_with_its_supervisor(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "kouxing.services.synthesizer"]
    starter = (
        "import os, subprocess\n"
        "os.environ['_KOUXING_SUPERVISOR'] = str(os.getpid())\n"
        f"print(subprocess.Popen({command}).pid, flush=True)\n"
    )
    parent = subprocess.run(
        [sys.executable, "-c", starter],
        env={**os.environ, **own_addresses(["synthesizer"])},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        timeout=60,
        check=True,
    )
    process = int(parent.stdout)
    end_s = time.monotonic() + 100
    while Path(f"/proc/{process}").exists():
        assert time.monotonic() < end_s, "the service outlived its supervisor"
        time.sleep(0.1)
