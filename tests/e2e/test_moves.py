"""A session whose recognizer or synthesizer is lost goes on with another one."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from kouxing_client import Client, Phone, Speech

from tests.e2e.following import KINDS, Collected, finish, samples_of_file, send, stream
from tests.system import DEMO, System

pytestmark = pytest.mark.e2e
OPEN_JAW = 2  # index of FAP 3
ONSET_TOLERANCE = 480  # samples: another recognizer has seen less sound before
SETTINGS = {"KOUXING_CONTROL_LOST_AFTER_S": "1"}


@pytest.mark.parametrize(
    ("service", "how", "moved"),
    [
        pytest.param("recognizer", signal.SIGKILL, {"audio", "phones"}, id="recognizer killed"),
        pytest.param("recognizer", signal.SIGTERM, {"audio", "phones"}, id="recognizer stopped"),
        pytest.param("synthesizer", signal.SIGTERM, {"faps"}, id="synthesizer stopped"),
    ],
)
def test_a_session_goes_on_when_its_worker_ends(
    tmp_path: Path, service: str, how: signal.Signals, moved: set[str]
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:56000]
    services = ("control", "recognizer", "synthesizer")
    with System(services, tmp_path, settings=SETTINGS) as system, Client(system.control) as client:
        undisturbed = final_phones(stream(system.control, samples))
        session = client.open_session(encoding="f32le")
        before = session.info
        output = session.results(*KINDS, keep_all=True)
        collected = Collected()
        send(session, samples[:24000], output, collected, paced=True)
        system.start_beside(service, "other")
        ended = system.processes.pop(service)
        ended.send_signal(how)
        if how == signal.SIGKILL:
            ended.wait()
        send(session, samples[24000:], output, collected, paced=True)
        finish(session, output, collected)
        after = session.info
        session.close()
        assert ended.wait(60) == (0 if how == signal.SIGTERM else -how)
        system.assert_all_alive()
        assert "session moved to" in system.log("control")

    assert before["epoch"] == 1 < after["epoch"]
    endpoints = ("audio", "phones", "faps")
    assert moved == {name for name in endpoints if before[name] != after[name]}
    assert missing_samples(collected, len(samples)) == 0, "the lost audio was not sent again"
    assert_same(final_phones(collected), undisturbed)
    frames = [frame for frame in collected.frames if frame.epoch == after["epoch"]]
    assert max(np.frombuffer(frame.values, "<f4")[OPEN_JAW] for frame in frames) > 100
    assert frames[-1].media_time >= len(samples)


def final_phones(collected: Collected) -> list[Phone]:
    """Return the phones of all epochs, without those that a new recognizer made void."""
    phones: list[Phone] = []
    epoch = 1
    for message in sorted([*collected.speech, *collected.phones], key=lambda each: each.epoch):
        if message.epoch > epoch and isinstance(message, Speech) and message.sequence == 1:
            phones = [phone for phone in phones if middle(phone) < message.media_time]
            epoch = message.epoch
        elif isinstance(message, Phone) and message.final and message.duration > 0:
            phones.append(message)
    return sorted(phones, key=lambda phone: phone.media_time)


def middle(phone: Phone) -> float:
    return phone.media_time + phone.duration / 2


def assert_same(phones: list[Phone], expected: list[Phone]) -> None:
    """No phone is lost or doubled, and all are where they are without a loss."""
    assert [phone.symbol for phone in phones] == [phone.symbol for phone in expected]
    for phone, other in zip(phones, expected, strict=True):
        assert abs(phone.media_time - other.media_time) <= ONSET_TOLERANCE


def missing_samples(collected: Collected, num_samples: int) -> int:
    """Return how many samples of the session's sound no recognizer has published."""
    is_there = np.zeros(num_samples, bool)
    for sound in collected.sounds:
        is_there[sound.media_time : sound.media_time + len(sound.pcm) // 2] = True
    return int((~is_there).sum())
