"""A worker that stands still is replaced, and publishes nothing when it goes on."""

from __future__ import annotations

import io
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from kouxing_client import Client
from rich.console import Console

from kouxing.evaluation.system.faults import SPIN
from kouxing.evaluation.system.systems import LocalSystem
from kouxing.shared.bus import Bus
from kouxing.shared.wire.face import FapFrame
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.speech import Phone
from tests.e2e.following import KINDS, Collected, finish, samples_of_file, send, stream
from tests.system import ANY_LOAD, DEMO, System

pytestmark = pytest.mark.e2e
SERVICES = ("control", "recognizer", "synthesizer")
MAX_TOLD_AT_ONCE = 6  # phones: one that is new revises those before it
SETTINGS = {"KOUXING_CONTROL_LOST_AFTER_S": "1"}


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_one_that_thaws_does_not_publish_beside_the_one_in_its_place(
    tmp_path: Path, bus: Bus, service: str
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:112000]
    with System(SERVICES, tmp_path, settings=SETTINGS) as system, Client(system.control) as client:
        session = client.open_session(encoding="f32le")
        output = session.results(*KINDS, keep_all=True)
        kind: type[Message]
        kind, endpoint = (
            (Phone, session.info["phones"])
            if service == "recognizer"
            else (FapFrame, session.info["faps"])
        )
        witness = bus.connect_subscriber(endpoint)
        witness.subscribe(kind, session.name)
        collected = Collected()
        system.start_beside(service, "other")
        send(session, samples[:24000], output, collected, paced=True)
        frozen = system.processes[service].pid
        os.kill(frozen, signal.SIGSTOP)
        until_moved = 24000
        while session.info["epoch"] == 1:
            assert until_moved < 80000, "it was not replaced"
            piece = samples[until_moved : until_moved + 1600]
            send(session, piece, output, collected, paced=True)
            until_moved += 1600
        while witness.wait(0.2):
            list(witness.receive())
        os.kill(frozen, signal.SIGCONT)
        send(session, samples[until_moved:], output, collected, paced=True)
        finish(session, output, collected)
        late = list(witness.receive())
        session.close()

    assert len(late) <= MAX_TOLD_AT_ONCE, "what it was in the midst of, and nothing else"
    epochs = [frame.epoch for frame in collected.frames]
    assert epochs == sorted(epochs)
    assert epochs[-1] == 2


def test_the_only_recognizer_goes_on_with_its_sessions_after_it_stood_still(
    tmp_path: Path,
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:64000]
    with System(SERVICES, tmp_path, settings=SETTINGS) as system, Client(system.control) as client:
        session = client.open_session(encoding="f32le")
        output = session.results(*KINDS, keep_all=True)
        collected = Collected()
        send(session, samples[:24000], output, collected, paced=True)
        frozen = system.processes["recognizer"].pid
        os.kill(frozen, signal.SIGSTOP)
        while "recognizer" in {service.service for service in client.status().services}:
            time.sleep(0.05)
        os.kill(frozen, signal.SIGCONT)
        send(session, samples[24000:], output, collected, paced=True)
        finish(session, output, collected)
        assert session.info["epoch"] == 1
        session.close()

    numbers = [frame.sequence for frame in collected.frames]
    assert numbers == [*range(1, len(numbers) + 1)]
    assert sum(len(sound.pcm) // 2 for sound in collected.sounds) == len(samples)


@pytest.fixture(scope="module")
def shown() -> io.StringIO:
    return io.StringIO()


@pytest.fixture(scope="module")
def supervised(
    tmp_path_factory: pytest.TempPathFactory, shown: io.StringIO
) -> Iterator[LocalSystem]:
    folder = tmp_path_factory.mktemp("supervised")
    (folder / "sitecustomize.py").write_text(SPIN.format(seconds=600), encoding="utf-8")
    console = Console(file=shown, width=200)
    settings = {**ANY_LOAD, "PYTHONPATH": str(folder)}
    with LocalSystem(folder, console, services=SERVICES, settings=settings) as system:
        yield system


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
@pytest.mark.parametrize("blow", [signal.SIGSTOP, signal.SIGUSR1], ids=["stopped", "hangs"])
def test_the_only_worker_is_ended_and_started_again_when_it_hangs(
    supervised: LocalSystem, shown: io.StringIO, service: str, blow: signal.Signals
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:56000]
    with Client(supervised.control) as client:
        undisturbed = stream(supervised.control, samples)
        session = client.open_session(encoding="f32le")
        output = session.results(*KINDS, keep_all=True)
        collected = Collected()
        send(session, samples[:24000], output, collected, paced=True)
        frozen = supervised.process_of(session.name, service)
        os.kill(frozen, blow)
        send(session, samples[24000:], output, collected, paced=True)
        finish(session, output, collected)
        assert supervised.process_of(session.name, service) != frozen
        session.close()

    assert f"{service} hangs" in shown.getvalue()
    times = {frame.media_time for frame in undisturbed.frames}
    assert times <= {frame.media_time for frame in collected.frames}
