"""A worker that stands still is replaced, and publishes nothing when it goes on."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from shared.client import Client
from shared.wire.face import FapFrame
from shared.wire.message import Message
from shared.wire.speech import Phone
from tests.e2e.following import KINDS, Collected, finish, samples_of_file, send
from tests.system import DEMO, System

pytestmark = pytest.mark.e2e
SERVICES = ("control", "recognizer", "synthesizer")
SETTINGS = {"KOUXING_CONTROL_LOST_AFTER_S": "1"}


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_one_that_thaws_does_not_publish_beside_the_one_in_its_place(
    tmp_path: Path, service: str
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:112000]
    with System(SERVICES, tmp_path, settings=SETTINGS) as system, Client(system.control) as client:
        session = client.open_session(encoding="f32le")
        output = session.subscribe(*KINDS)
        kind: type[Message]
        kind, endpoint = (
            (Phone, session.opened.phones)
            if service == "recognizer"
            else (FapFrame, session.opened.faps)
        )
        witness = client.bus.connect_subscriber(endpoint)
        witness.subscribe(kind, session.name)
        collected = Collected()
        system.start_beside(service, "other")
        send(session, samples[:24000], output, collected, paced=True)
        frozen = system.processes[service].pid
        os.kill(frozen, signal.SIGSTOP)
        until_moved = 24000
        while session.opened.epoch == 1:
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

    assert len(late) <= 2, "what it was in the midst of, and nothing else"
    epochs = [frame.epoch for frame in collected.frames]
    assert epochs == sorted(epochs)
    assert epochs[-1] == 2


def test_the_only_recognizer_goes_on_with_its_sessions_after_it_stood_still(
    tmp_path: Path,
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:64000]
    with System(SERVICES, tmp_path, settings=SETTINGS) as system, Client(system.control) as client:
        session = client.open_session(encoding="f32le")
        output = session.subscribe(*KINDS)
        collected = Collected()
        send(session, samples[:24000], output, collected, paced=True)
        frozen = system.processes["recognizer"].pid
        os.kill(frozen, signal.SIGSTOP)
        while "recognizer" in {service.service for service in client.status().services}:
            time.sleep(0.05)
        os.kill(frozen, signal.SIGCONT)
        send(session, samples[24000:], output, collected, paced=True)
        finish(session, output, collected)
        assert session.opened.epoch == 1
        session.close()

    numbers = [frame.sequence for frame in collected.frames]
    assert numbers == [*range(1, len(numbers) + 1)]
    assert sum(len(sound.pcm) // 2 for sound in collected.sounds) == len(samples)
