"""The supervisor of ``kouxing run``, without processes, and what its console shows of the logs."""

import contextlib
import errno
import io
import json
import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from kouxing.services.cli.launch import supervisor
from kouxing.services.cli.launch.supervisor import Supervisor, _console_text, _Service
from kouxing.shared.errors import UserError


def test_a_gateway_that_stops_after_its_start_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = SimpleNamespace(status=lambda: SimpleNamespace(services=[]))
    monkeypatch.setattr(supervisor, "connect_client", lambda _: contextlib.nullcontext(client))
    started = Supervisor([], tmp_path, Console(file=io.StringIO()), services=())
    with pytest.raises(UserError, match=r"the gateway stopped; see .*/gateway\.log"):
        started.page_address("tcp://127.0.0.1:1")


def test_a_service_whose_process_cannot_be_started_is_started_again_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, started = 100.0, list[float]()

    def start_process(*_: object, **__: object) -> SimpleNamespace:
        started.append(now_s)
        if len(started) == 1:
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return SimpleNamespace(stderr=None, wait=lambda: 0)

    console = Console(file=io.StringIO())
    watched = Supervisor([], tmp_path, console, services=())
    log = tmp_path / "control.log"
    service = _Service("control", log, {}, restart_at_s=now_s, error="of an earlier process")
    watched._services["control"] = service
    monkeypatch.setattr(supervisor, "ServiceProcess", start_process)
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    watched.check()
    watched.check()
    assert started == [100.0]
    assert service.process is None
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().startswith("control cannot start: Resource temporarily un")
    now_s += supervisor.MAX_BACKOFF_S
    watched.check()
    assert started == [100.0, 100.0 + supervisor.MAX_BACKOFF_S]
    assert service.process is not None
    assert service.error == ""


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"level": "info", "message": "opened", "session": "s1"}, ""),
        ({"level": "warning", "message": "slow"}, "slow"),
        ({"level": "warning", "message": "slow", "session": "s1"}, "session 's1': slow"),
        ({"level": "warning", "message": "'s1' is slow", "session": "s1"}, "'s1' is slow"),
    ],
)
def test_a_warning_names_its_session(entry: dict[str, str], text: str) -> None:
    assert _console_text(json.dumps(entry).encode()) == text


def test_other_text_is_shown_as_it_is() -> None:
    assert _console_text(b"Segmentation fault\n") == "Segmentation fault"


def test_a_long_warning_is_one_line(tmp_path: Path) -> None:
    output = io.StringIO()
    started = Supervisor([], tmp_path, Console(file=output, width=40), services=())
    started._warn("turn the receiver on, " * 5)
    assert len(output.getvalue().splitlines()) == 1


def test_the_log_is_shown_and_an_error_in_the_configuration_is_kept(tmp_path: Path) -> None:
    output = io.StringIO()
    started = Supervisor([], tmp_path, Console(file=output), services=())
    service = _Service("gateway", tmp_path / "gateway.log", {})
    expired = json.dumps({"level": "warning", "message": "gateway.https: k.pem is expired"})
    started._copy_log(service, io.BytesIO(expired.encode() + b"\n"))
    assert output.getvalue() == "gateway.https: k.pem is expired\n"
    assert service.error == ""
    started._copy_log(service, io.BytesIO(b"gateway.port: 0 is too small\n"))
    assert output.getvalue().count("\n") == 1
    assert service.error == "gateway.port: 0 is too small"
