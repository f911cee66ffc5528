"""The supervisor of ``kouxing run``, without processes, and what its console shows of the logs."""

import contextlib
import errno
import io
import json
import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from kouxing.services.cli.launch import supervisor
from kouxing.services.cli.launch.supervisor import Supervisor
from kouxing.shared.errors import USER_ERROR, UserError
from tests.system import LIMIT_S

WRONG_PORT = b"gateway.port: 0 is too small\n"


class EndedProcess:
    """A process that has written its log and ended."""

    is_unresponsive = False

    def __init__(self, status: int, log: bytes = b"", *, is_ready: bool = False) -> None:
        self.is_ready = is_ready
        self.stderr = io.BytesIO(log)
        self._status = status
        self._was_read = threading.Event()

    def kill(self) -> None:
        """Do nothing."""

    def read_heartbeats(self) -> None:
        """Do nothing."""

    def wait(self) -> int:
        self._was_read.set()  # the supervisor waits after the end of the log
        return self._status

    def poll(self) -> int:
        assert self._was_read.wait(LIMIT_S)
        return self._status


class ConsoleOfSupervisor:
    """A supervisor whose service ends at once, and its console."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, width: int = 80) -> None:
        self.output = io.StringIO()
        self._monkeypatch = monkeypatch
        self._supervisor = Supervisor(
            [], folder, Console(file=self.output, width=width), services=()
        )

    def error_after(self, log: bytes) -> str:
        """Return the error after the gateway has reported a wrong configuration."""
        process = EndedProcess(USER_ERROR, log)
        self._monkeypatch.setattr(supervisor, "ServiceProcess", lambda *_, **__: process)
        self._supervisor.start_service("gateway", {})
        with pytest.raises(UserError) as error:
            self._supervisor.check()
        return str(error.value)


def test_a_gateway_that_stops_after_its_start_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = SimpleNamespace(status=lambda: SimpleNamespace(services=[]))
    monkeypatch.setattr(supervisor, "connect_client", lambda _: contextlib.nullcontext(client))
    started = Supervisor([], tmp_path, Console(file=io.StringIO()), services=())
    with pytest.raises(UserError, match=r"the gateway stopped; see .*/gateway\.log"):
        started.page_address("tcp://127.0.0.1:1")


@pytest.mark.parametrize(
    ("missing", "reason"),
    [("process", "Resource temporarily un"), ("thread", "can't start new thread")],
)
def test_a_service_whose_process_or_thread_cannot_be_started_is_started_again_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str, reason: str
) -> None:
    now_s, started = 100.0, list[float]()
    run_thread = threading.Thread.start

    def start_process(*_: object, **__: object) -> EndedProcess:
        started.append(now_s)
        if len(started) == 2 and missing == "process":
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        if len(started) == 1:
            return EndedProcess(1, b"control: an error of the first process\n")
        return EndedProcess(USER_ERROR)

    def start_thread(thread: threading.Thread) -> None:
        if len(started) == 2 and missing == "thread":
            raise RuntimeError("can't start new thread")
        run_thread(thread)

    output = io.StringIO()
    watched = Supervisor([], tmp_path, Console(file=output), services=())
    monkeypatch.setattr(supervisor, "ServiceProcess", start_process)
    monkeypatch.setattr(threading.Thread, "start", start_thread)
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    watched.start_service("control", {})
    watched.check()
    watched.check()
    assert started == [100.0, 100.0]
    with pytest.raises(KeyError):
        watched.process("control")
    ended, cannot_start = output.getvalue().splitlines()
    assert ended == "control ended with status 1; restarting control now"
    assert cannot_start.startswith(f"control cannot start: {reason}")
    now_s += supervisor.MAX_BACKOFF_S
    watched.check()
    assert started == [100.0, 100.0, 100.0 + supervisor.MAX_BACKOFF_S]
    with pytest.raises(UserError, match=r"control cannot start; see .*/control\.log"):
        watched.check()


def test_a_first_process_that_cannot_be_started_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start_process(*_: object, **__: object) -> EndedProcess:
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(supervisor, "ServiceProcess", start_process)
    with pytest.raises(UserError, match=r"cannot start control: .*; close other programs, or"):
        Supervisor([], tmp_path, Console(), services=("control",)).start()


def test_a_wrong_configuration_at_a_restart_is_reported_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    processes = [EndedProcess(1, is_ready=True), EndedProcess(USER_ERROR, WRONG_PORT)]
    started = iter(processes)
    output = io.StringIO()
    watched = Supervisor([], tmp_path, Console(file=output), services=())
    monkeypatch.setattr(supervisor, "ServiceProcess", lambda *_, **__: next(started))
    monkeypatch.setattr(time, "monotonic", lambda: 100.0)
    watched.start_service("gateway", {})
    watched.check()
    watched.check()
    assert output.getvalue().splitlines() == [
        "gateway ended with status 1; restarting gateway now",
        "gateway.port: 0 is too small; restarting gateway in 0.2 s",
    ]


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (b'{"level": "info", "message": "opened", "session": "s1"}', ""),
        (b'{"level": "warning", "message": "slow"}', "slow\n"),
        (b'{"level": "warning", "message": "slow", "session": "s1"}', "session 's1': slow\n"),
        (b'{"level": "warning", "message": "\'s1\' is slow", "session": "s1"}', "'s1' is slow\n"),
        (b"Segmentation fault\n", "Segmentation fault\n"),
    ],
)
def test_warnings_with_their_session_and_other_text_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: bytes, text: str
) -> None:
    console = ConsoleOfSupervisor(tmp_path, monkeypatch)
    console.error_after(line)
    assert console.output.getvalue() == (text and f"gateway: {text}")


def test_a_long_warning_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    console = ConsoleOfSupervisor(tmp_path, monkeypatch, width=40)
    entry = {"level": "warning", "message": "turn the receiver on, " * 5}
    console.error_after(json.dumps(entry).encode())
    assert len(console.output.getvalue().splitlines()) == 1


def test_the_log_is_shown_and_an_error_in_the_configuration_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    console = ConsoleOfSupervisor(tmp_path, monkeypatch)
    expired = json.dumps({"level": "warning", "message": "gateway.https: k.pem is expired"})
    line = expired.encode() + b"\n"
    assert console.error_after(line).startswith("gateway cannot start; see ")
    assert console.output.getvalue() == "gateway.https: k.pem is expired\n"
    assert console.error_after(line + WRONG_PORT) == "gateway.port: 0 is too small"
    assert console.output.getvalue() == 2 * "gateway.https: k.pem is expired\n"
    assert (tmp_path / "gateway.log").read_bytes() == line + line + WRONG_PORT
