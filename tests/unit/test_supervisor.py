"""The supervisor of ``kouxing run``, without processes."""

import contextlib
import errno
import io
import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from kouxing.services.cli.launch import supervisor
from kouxing.shared.errors import UserError


def test_a_gateway_that_stops_after_its_start_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = SimpleNamespace(status=lambda: SimpleNamespace(services=[]))
    monkeypatch.setattr(supervisor, "connect_client", lambda _: contextlib.nullcontext(client))
    started = supervisor.Supervisor([], tmp_path, Console(file=io.StringIO()), services=())
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
    watched = supervisor.Supervisor([], tmp_path, console, services=())
    service = supervisor._Service(
        "control", tmp_path / "control.log", {}, restart_at_s=now_s, error="of an earlier process"
    )
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
