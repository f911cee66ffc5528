"""Control reports lost services that do not return within a second."""

import logging

import pytest

from kouxing.services.control.faults import Faults
from kouxing.shared.logs import LOG


@pytest.mark.parametrize(
    ("lasts_s", "level", "is_back_logged"),
    [(0.8, logging.INFO, "recognizer-1 is back after 0.8 s"),
     (2.0, logging.WARNING, "recognizer-1 is back after 2.0 s")],
)  # fmt: skip
def test_only_long_faults_are_reported_with_their_end(
    caplog: pytest.LogCaptureFixture, lasts_s: float, level: int, is_back_logged: str
) -> None:
    faults = Faults()
    with caplog.at_level(logging.INFO, LOG.name):
        LOG.addHandler(caplog.handler)
        faults.begin("recognizer-1", "no heartbeat", 10.0)
        for tick in range(1, 20):
            faults.report(10.0 + min(tick * 0.1, lasts_s))
        faults.end("recognizer-1", 10.0 + lasts_s)
        faults.end("recognizer-1", 20.0)
        LOG.removeHandler(caplog.handler)
    texts = {record.getMessage(): record.levelno for record in caplog.records}
    assert texts == {"lost recognizer-1: no heartbeat": level, is_back_logged: level}
