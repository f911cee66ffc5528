"""A service process: SIGTERM ends it with status 0, a wrong configuration with status 2."""

import os
import signal
import socket
import sys
from pathlib import Path

import pytest

from kouxing.shared.settings.config import variable_name
from tests.system import (
    CODE_PATH,
    LIMIT_S,
    SERVICE,
    can_connect,
    own_addresses,
    start_python,
    wait_until,
)


def run_to_end(*arguments: str, **environment: str) -> tuple[int, str]:
    """Return the exit status of a program, and what it prints on standard error."""
    process = start_python(*arguments, **environment)
    _, log = process.communicate(timeout=LIMIT_S)
    return process.returncode, log


def test_ctrl_c_during_startup_prints_no_traceback() -> None:
    addresses = own_addresses(["recognizer"])
    port = int(addresses[variable_name("recognizer", "audio")].rpartition(":")[2])
    process = start_python(*SERVICE, "recognizer", **addresses)
    wait_until(lambda: can_connect(port))  # bound, but no model is loaded yet
    process.send_signal(signal.SIGINT)
    _, log = process.communicate(timeout=LIMIT_S)
    assert process.returncode in (-signal.SIGINT, 0)
    assert "Traceback" not in log


@pytest.mark.parametrize(
    ("arguments", "slow_import"),
    [((*SERVICE, "recognizer"), "msgspec"), (("-m", "kouxing"), "typer")],
)
def test_ctrl_c_in_imports_prints_nothing(
    tmp_path: Path, arguments: tuple[str, ...], slow_import: str
) -> None:
    ctrl_c = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
    (tmp_path / f"{slow_import}.py").write_text(ctrl_c)
    path = f"{tmp_path}{os.pathsep}{CODE_PATH}"
    assert run_to_end(*arguments, PYTHONPATH=path) == (-signal.SIGINT, "")


@pytest.mark.parametrize(("service", "key"), [("recognizer", "audio"), ("gateway", "port")])
def test_reports_a_port_in_use(service: str, key: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        value = str(port) if key.endswith("port") else f"tcp://127.0.0.1:{port}"
        environment = {**own_addresses([service]), variable_name(service, key): value}
        status, log = run_to_end(*SERVICE, service, **environment)
    assert status == 2
    assert key in log
    assert "Traceback" not in log


@pytest.mark.parametrize("key", ["log_level", "driver.log_level"])
def test_reports_a_wrong_setting_before_it_binds_anything(key: str) -> None:
    status, log = run_to_end(*SERVICE, "driver", "--set", f"{key}=loud")
    assert status == 2
    assert "'loud' (from --set) is not one of" in log
    assert "driver.log_level" in log
    assert "Traceback" not in log


def test_a_service_ends_with_its_supervisor() -> None:
    command = [sys.executable, *SERVICE, "synthesizer"]
    starter = (
        "import os, subprocess\n"
        "os.environ['_KOUXING_SUPERVISOR'] = str(os.getpid())\n"
        f"print(subprocess.Popen({command}, stdout=-3, stderr=-3).pid, flush=True)\n"
    )
    with start_python("-c", starter, **own_addresses(["synthesizer"])) as parent:
        assert parent.stdout is not None
        process = int(parent.stdout.readline())
    wait_until(lambda: not Path(f"/proc/{process}").exists())
