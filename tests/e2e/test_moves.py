"""A live session whose recognizer or synthesizer is lost continues with another one.

tests/property/test_face_moves.py checks that the face does not jump.
"""

import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest
from kouxing_client import Client
from kouxing_client.messages import FapFrame, Phone

from kouxing.shared.network.bus import Bus
from tests.e2e.streaming import StreamedSession, stream_audio
from tests.system import CHAIN, DEMO, LIMIT_S, System, samples_of_file

SAMPLES = samples_of_file(DEMO / "hello-female.wav")[:64000]
LOST_AT = 24000  # samples
ONSET_TOLERANCE = 480  # samples: another recognizer has processed less audio before
MAX_LATE = 6  # messages: a new phone revises those before it
MOVED = {"recognizer": {"audio", "phones"}, "synthesizer": {"faps"}}


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    settings = {"KOUXING_CONTROL_LOST_AFTER_S": "6"}  # a busy service is not lost
    with System(CHAIN, tmp_path_factory.mktemp("moves"), settings) as running:
        yield running


@pytest.fixture(scope="module")
def uninterrupted(system: System) -> StreamedSession:
    return stream_audio(system.control, SAMPLES)


def test_a_recognizer_that_was_suspended_keeps_its_session(system: System) -> None:
    samples = SAMPLES[:48000]
    with Client(system.control) as client, client.open_session(encoding="f32le") as session:
        streamed = StreamedSession(session)
        streamed.send(samples[:LOST_AT], paced=True)
        system.process("recognizer").send_signal(signal.SIGSTOP)
        system.wait_until(
            lambda report: "recognizer" not in {state.service for state in report.services}
        )
        system.process("recognizer").send_signal(signal.SIGCONT)
        streamed.send(samples[LOST_AT:], paced=True)
        streamed.finish()
        assert session.info["epoch"] == 1
    assert [frame.sequence for frame in streamed.frames] == [*range(1, len(streamed.frames) + 1)]
    assert num_missing_samples(streamed, len(samples)) == 0


@pytest.mark.parametrize("blow", [signal.SIGSTOP, signal.SIGTERM])
@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_a_session_continues_without_its_worker(
    system: System, uninterrupted: StreamedSession, bus: Bus, service: str, blow: signal.Signals
) -> None:
    if sum(name.startswith(service) for name in system.running) < 2:
        system.add(f"{service}-2")
    with Client(system.control) as client, client.open_session(encoding="f32le") as session:
        streamed = StreamedSession(session)
        streamed.send(SAMPLES[:LOST_AT], paced=True)
        before = session.info
        is_recognizer = service == "recognizer"
        witness = bus.connect_subscriber(before["phones" if is_recognizer else "faps"])
        witness.subscribe(Phone if is_recognizer else FapFrame, session.name)
        name = system.instance_of(session.name, service)
        lost = system.lose(name, blow)
        unsent, end_s = SAMPLES[LOST_AT:], time.monotonic() + LIMIT_S
        while session.info["epoch"] == before["epoch"]:
            assert time.monotonic() < end_s, "the session did not move"
            streamed.send(unsent[:1600], paced=True)
            streamed.collect(0.1 if len(unsent) == 0 else 0.0)
            unsent = unsent[1600:]
            if blow == signal.SIGTERM and name not in instances_of(client):
                assert session.info["epoch"] > before["epoch"], "it left before its session moved"
        while witness.wait(1.0):
            list(witness.receive())
        if blow == signal.SIGSTOP:
            lost.send_signal(signal.SIGCONT)
            system.running.add(name)
        else:
            assert lost.wait(LIMIT_S) == 0
        streamed.send(unsent, paced=True)
        streamed.finish()
        after = session.info
        system.assert_all_alive()
    assert len(list(witness.receive())) <= MAX_LATE, "a lost worker finishes only its message"

    assert {key for key in ("audio", "phones", "faps") if before[key] != after[key]} == (
        MOVED[service]
    )
    assert num_missing_samples(streamed, len(SAMPLES)) == 0, "the lost audio was not resent"
    phones, expected = (
        [phone for phone in result.phones if phone.is_spoken]
        for result in (streamed, uninterrupted)
    )
    assert [phone.symbol for phone in phones] == [phone.symbol for phone in expected]
    for phone, other in zip(phones, expected, strict=True):
        assert abs(phone.media_time - other.media_time) <= ONSET_TOLERANCE
    epochs = [frame.epoch for frame in streamed.frames]
    assert epochs == sorted(epochs)
    assert {*uninterrupted.times} <= {*streamed.times}


def instances_of(client: Client) -> set[str]:
    return {state.instance for state in client.status().services}


def num_missing_samples(streamed: StreamedSession, num_samples: int) -> int:
    """Return how many samples of the session's sound no recognizer has published."""
    is_published = np.zeros(num_samples, bool)
    for sound in streamed.sounds:
        is_published[sound.media_time : sound.media_time + len(sound.pcm) // 2] = True
    return int((~is_published).sum())
