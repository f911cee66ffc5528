"""A session whose recognizer or synthesizer is lost goes on at another one's address."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shared.client import Client
from tests.e2e.following import KINDS, Collected, finish, samples_of_file, send
from tests.system import DEMO, System

pytestmark = pytest.mark.e2e
OPEN_JAW = 2  # index of FAP 3
SAMPLES_MISSED = {"recognizer": 0, "synthesizer": 640}  # the follower subscribes anew meanwhile
SETTINGS = {"KOUXING_CONTROL_LOST_AFTER_S": "1"}


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_a_session_goes_on_elsewhere_when_its_worker_is_killed(
    tmp_path: Path, service: str
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:56000]
    services = ("control", "recognizer", "synthesizer")
    with System(services, tmp_path, settings=SETTINGS) as system, Client(system.control) as client:
        session = client.open_session(encoding="f32le")
        before = session.opened
        output = session.subscribe(*KINDS)
        collected = Collected()
        send(session, samples[:24000], output, collected, paced=True)
        system.start_beside(service, "other")
        killed = system.processes.pop(service)
        killed.kill()
        killed.wait()
        send(session, samples[24000:], output, collected, paced=True)
        finish(session, output, collected)
        after = session.opened
        session.close()
        system.assert_all_alive()

    assert before.epoch == 1 < after.epoch
    moved = {
        name
        for name in ("audio", "phones", "faps")
        if getattr(before, name) != getattr(after, name)
    }
    assert moved == ({"audio", "phones"} if service == "recognizer" else {"faps"})
    num_missing = missing_samples(collected, len(samples))
    assert num_missing <= SAMPLES_MISSED[service], "the lost audio was not sent again"
    later = [phone for phone in collected.phones if phone.epoch == after.epoch]
    assert any(phone.final for phone in later)
    frames = [frame for frame in collected.frames if frame.epoch == after.epoch]
    assert max(np.frombuffer(frame.values, "<f4")[OPEN_JAW] for frame in frames) > 100
    assert frames[-1].media_time >= len(samples)


def missing_samples(collected: Collected, num_samples: int) -> int:
    """Return how many samples of the session's sound no recognizer has published."""
    is_there = np.zeros(num_samples, bool)
    for sound in collected.sounds:
        is_there[sound.media_time : sound.media_time + len(sound.pcm) // 2] = True
    return int((~is_there).sum())
