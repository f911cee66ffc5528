"""A crashed service is started again and its sessions go on."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from kouxing_client import Client, Session
from numpy.typing import NDArray
from rich.console import Console

from kouxing.services.cli.supervisor import Supervisor
from kouxing.shared.errors import UserError
from tests.e2e.following import samples_of_file
from tests.system import DEMO
from tests.watched import Watched

pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    with Watched(tmp_path_factory.mktemp("logs")) as watched:
        yield watched


def moves(session: Session, samples: NDArray[np.float32]) -> bool:
    """Stream samples in real time; return whether the mouth opens and frames keep coming."""
    output = session.frames()
    opening = 0.0
    begin, end_s = 0, time.monotonic() + 60
    while begin < len(samples) or (opening <= 100 and time.monotonic() < end_s):
        if begin < len(samples):
            session.push(samples[begin : begin + 320])
            begin += 320
        assert session.take_errors() == []
        for frame in output.available(0.02):
            opening = max(opening, *map(abs, frame.values[2:13]))
    return opening > 100


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_a_session_goes_on_after_a_crash(watched: Watched, service: str) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")
    with Client(watched.control) as client:
        session = client.open_session(encoding="f32le", sample_rate_hz=16000)
        assert moves(session, samples[:24000])
        old = watched.instance(client, service)
        watched.kill(service)
        watched.until_replaced(client, service, old)
        time.sleep(0.5)
        assert moves(session, samples[24000:72000])
        session.close()
    assert f"{service} ended with status -9" in watched.shown.getvalue()


def test_the_driver_and_the_gateway_come_back_too(watched: Watched) -> None:
    with Client(watched.control) as client:
        for service in ("driver", "gateway"):
            old = watched.instance(client, service)
            watched.kill(service)
            watched.until_replaced(client, service, old)


def test_a_service_that_is_configured_wrongly_ends_the_wait(tmp_path: Path) -> None:
    arguments = ["--config", str(tmp_path / "absent.toml")]
    supervisor = Supervisor(arguments, tmp_path, Console(file=io.StringIO()))
    try:
        supervisor.start()
        supervisor.watch()
        with pytest.raises(UserError, match="cannot start"):
            supervisor.wait()
    finally:
        supervisor.stop()
