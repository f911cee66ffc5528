"""The supervisor of ``kouxing run``, without processes."""

import contextlib
import io
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
