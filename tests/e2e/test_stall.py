"""The face goes to rest when its live client is silent, and only then."""

from __future__ import annotations

import itertools
import signal
import time
from pathlib import Path

import pytest
from kouxing_client import Client

from tests.e2e.following import KINDS, Collected, samples_of_file, send
from tests.system import DEMO, System

pytestmark = pytest.mark.e2e


def num_standing(collected: Collected) -> int:
    """Return how many frames repeat the media time of the one before, once sound has come."""
    times = [frame.media_time for frame in collected.frames if frame.media_time > 0]
    return sum(after == before for before, after in itertools.pairwise(times))


def test_a_face_waits_for_a_slow_recognizer_and_rests_for_a_silent_client(tmp_path: Path) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:88_000]
    services = ("control", "recognizer", "synthesizer")
    with System(services, tmp_path) as system, Client(system.control) as client:
        session = client.open_session(encoding="f32le")
        output = session.results(*KINDS, keep_all=True)
        collected = Collected()
        send(session, samples[:16_000], output, collected, paced=True)
        recognizer = system.processes["recognizer"]
        recognizer.send_signal(signal.SIGSTOP)
        try:
            send(session, samples[16_000:56_000], output, collected, paced=True)
        finally:
            recognizer.send_signal(signal.SIGCONT)
        send(session, samples[56_000:], output, collected, paced=True)
        end_s = time.monotonic() + 60
        while (
            collected.frames[-1].media_time < len(samples) - 3200 and num_standing(collected) == 0
        ):
            assert time.monotonic() < end_s
            collected.add(output.available(0.1))
        assert num_standing(collected) == 0, "the client was not silent"
        assert session.take_errors() == []

        while num_standing(collected) < 10:
            assert time.monotonic() < end_s, "the client is silent, and the face does not rest"
            collected.add(output.available(0.1))
        session.close()
        system.assert_all_alive()
