"""Services and a client on separate machines, each with the key that was copied there."""

import socket
import subprocess
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.service_kinds import KINDS
from kouxing.shared.settings.keys import key_folder, read_grants
from tests.e2e.conftest import CommandRunner
from tests.e2e.streaming import stream_audio
from tests.system import SERVICE, System, kouxing, own_addresses, start_python, wait_until

WORKERS = ("recognizer", "synthesizer")
pytestmark = pytest.mark.usefixtures("new_keys")


def create_machine(command: CommandRunner, folder: Path, name: str, role: str, file: str) -> Path:
    """Create a key by the command, and the state folder of another machine with only this key."""
    status, _, log = command("keys", "add", name, "--role", role, "-o", folder / f"{name}.key")
    assert (status, f"/{file}.key on the other machine" in log) == (0, True), log
    keys = folder / name / "kouxing"
    keys.mkdir(parents=True, mode=0o700)
    (folder / f"{name}.key").rename(keys / f"{file}.key")
    return folder / name


def test_init_makes_the_keys_of_all_services(command: CommandRunner) -> None:
    assert command("keys", "init")[0] == 0
    roles = {grant.name: grant.roles for grant in read_grants().values()}
    assert roles.keys() == {*KINDS, "client"} - {"control"}
    assert roles["gateway"] == ("service:gateway", "client")
    assert {path.stem for path in key_folder().glob("*.key")} == {*KINDS, "client"}


def test_machines_with_copied_keys_work_until_the_keys_are_revoked(
    command: CommandRunner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"KOUXING_CONTROL_LOST_AFTER_S": "6"}  # a busy service is not lost
    with System(["control"], tmp_path, settings) as system:
        for kind in WORKERS:
            own = create_machine(command, tmp_path, f"{kind}-host", f"service:{kind}", kind)
            system.add(kind, XDG_STATE_HOME=str(own))
        laptop = create_machine(command, tmp_path, "laptop", "client", "client")
        monkeypatch.setenv("XDG_STATE_HOME", str(laptop))
        assert stream_audio(system.control, np.zeros(3200, np.float32)).frames
        checked = kouxing("doctor", control=system.control)
        assert checked.returncode == 0, checked.stdout
        assert "key client: control accepts it" in checked.stdout
        assert "0 of 5 checks failed" in checked.stdout
        (laptop / "kouxing").chmod(0o755)
        checked = kouxing("doctor", control=system.control)
        assert "FAIL key client: cannot be used" in checked.stdout
        (laptop / "kouxing").chmod(0o700)
        status, _, log = command("keys", "add", "friend")
        assert (status, "on control's machine" in log) == (2, True), log

        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
        _, listed, _ = command("keys", "list")
        assert all(name in listed for name in ("recognizer-host", "synthesizer-host", "laptop"))
        assert command("keys", "revoke", "recognizer-host")[0] == 0
        system.wait_until(
            lambda report: "recognizer" not in {item.service for item in report.services}
        )
        advice = "kouxing keys add NAME --role service:recognizer"
        wait_until(lambda: advice in system.log("recognizer"))
        system.assert_all_alive()


def test_doctor_recognizes_another_program(command: CommandRunner) -> None:
    assert command("keys", "init")[0] == 0
    with socket.create_server(("127.0.0.1", 0)) as other:
        checked = kouxing("doctor", control=f"tcp://127.0.0.1:{other.getsockname()[1]}")
    assert "another program answers there" in checked.stdout


def test_a_service_waits_for_control_and_says_why(command: CommandRunner) -> None:
    assert command("keys", "init")[0] == 0
    addresses = own_addresses(["control", "synthesizer"])
    started = [start_python(*SERVICE, "synthesizer", **addresses)]
    try:
        log = read_until("nothing listens there; start kouxing there", started[0])
        assert "waiting for control at tcp://127.0.0.1" in log
        assert '"ready' not in log
        checked = kouxing("doctor", environment=addresses)
        assert checked.returncode == 1
        assert "FAIL control at tcp://127.0.0.1" in checked.stdout
        started.append(start_python(*SERVICE, "control", **addresses))
        read_until('"message": "ready ', started[0])
    finally:
        for process in started:
            process.terminate()
            process.communicate()


def read_until(text: str, process: subprocess.Popen[str]) -> str:
    log = ""
    while text not in log:
        line = process.stderr.readline() if process.stderr else ""
        assert line, f"it ended: {log}"
        log += line
    return log
