"""Log lines are JSON and name the session that they concern, a crash's too."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator

import pytest

from kouxing.shared.bus import Bus
from kouxing.shared.config import ServiceConfig
from kouxing.shared.keys import Peer
from kouxing.shared.logs import LOG
from kouxing.shared.service import Service, run_service
from kouxing.shared.wire.control import Heartbeat
from kouxing.shared.wire.speech import Progress, Speech

pytestmark = pytest.mark.unit


class Failing(Service):
    """Fails on progress, and knows no other message."""

    name = "failing"
    role = "worker"

    def __init__(self) -> None:
        super().__init__(ServiceConfig(insecure=True), control=False)
        self.input = self.bus.bind_router("tcp://127.0.0.1:*", "failing.input")
        self.register(self.input, {Progress: self._on_progress})
        self.peer = Bus()

    def on_heartbeat_due(self, heartbeat: Heartbeat) -> None:
        pass

    def on_start(self) -> None:
        sender = self.peer.connect_dealer(self.input.endpoint)
        sender.send(Speech(session="first", active=True))
        sender.send(Progress(session="second", level_db=0.0))

    def _on_progress(self, _progress: Progress, _sender: Peer) -> None:
        raise ZeroDivisionError


@pytest.fixture
def _own_log() -> Iterator[None]:
    handlers, level, propagate = LOG.handlers[:], LOG.level, LOG.propagate
    yield
    LOG.handlers[:], LOG.propagate = handlers, propagate
    LOG.setLevel(level or logging.NOTSET)


@pytest.mark.usefixtures("_own_log")
def test_warnings_and_a_crash_name_the_session(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Service, "_install_signals", lambda _: None)
    made: list[Failing] = []

    def make() -> Service:
        made.append(Failing())
        return made[0]

    assert run_service(make, "failing", "info") == 1
    made[0].peer.close()
    made[0].bus.close()
    lines = {
        line["session"]: line
        for line in map(json.loads, capsys.readouterr().err.splitlines())
        if "session" in line
    }
    assert lines["first"]["level"] == "warning"
    assert "not expected here" in lines["first"]["message"]
    assert lines["second"]["level"] == "critical"
    assert "ZeroDivisionError" in lines["second"]["traceback"]
    assert {line["service"] for line in lines.values()} == {"failing"}
