"""Log lines are JSON and name their session, also after a crash."""

import json
import logging
from collections.abc import Iterator
from typing import Any

import pytest

from kouxing.services.process import run_service
from kouxing.shared.logs import LOG, configure


class Crashing:
    current_session = "second"

    def startup(self) -> None:
        pass

    def run(self) -> None:
        LOG.warning("dropped", extra={"session": "first"})
        raise ZeroDivisionError


@pytest.fixture(autouse=True)
def restore_log() -> Iterator[None]:
    handlers, level, propagate = LOG.handlers[:], LOG.level, LOG.propagate
    yield
    LOG.handlers[:], LOG.propagate = handlers, propagate
    LOG.setLevel(level or logging.NOTSET)


def test_warnings_and_a_crash_name_the_session(capsys: pytest.CaptureFixture[str]) -> None:
    make: Any = Crashing
    assert run_service(make, "failing", "info") == 1
    first, second = map(json.loads, capsys.readouterr().err.splitlines())
    assert (first["level"], first["session"], first["message"]) == ("warning", "first", "dropped")
    assert (second["level"], second["session"]) == ("critical", "second")
    assert "ZeroDivisionError" in second["traceback"]
    assert first["service"] == second["service"] == "failing"
    configure("quiet", "warning")
    LOG.info("ready")
    assert capsys.readouterr().err == ""
