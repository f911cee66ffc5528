"""A face is live again after its service was stopped, and the skipped audio is reported."""

import signal
from collections.abc import Iterator

import numpy as np
import pytest
from kouxing_client import Client

from tests.e2e.following import RATE_HZ, Stream, samples_of_file
from tests.system import CHAIN, CHEAP, DEMO, System, wait_until

STOPPED_S = 2  # far less than the time after which control counts a service as lost
SETTINGS = {
    **CHEAP,
    "KOUXING_RECOGNIZER_MAX_BEHIND_S": "0.2",
    "KOUXING_SYNTHESIZER_MAX_BEHIND_S": "0.2",
}


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    with System(CHAIN, tmp_path_factory.mktemp("overload"), SETTINGS) as running:
        yield running


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_a_stopped_service_continues_with_the_newest_audio(system: System, service: str) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")
    sentence = np.resize(samples, (STOPPED_S + 1) * RATE_HZ)
    with Client(system.control) as client, client.open_session(encoding="f32le") as session:
        events = session.events()
        sent = Stream(session)
        sent.send(sentence[:RATE_HZ], paced=True)
        stopped = system.process(service)
        stopped.send_signal(signal.SIGSTOP)
        sent.send(sentence[RATE_HZ:], paced=True)
        stopped.send_signal(signal.SIGCONT)
        resumed = sent.num_sent
        wait_until(
            lambda: sent.times and sent.times[-1] > resumed,
            step=lambda: sent.send(samples[:1600], paced=True),
        )
        wait_until(lambda: "audio-skipped" in {event.name for event in events.available(0.1)})
        wait_until(lambda: client.status().sessions[0].skipped_s > 0.0)
        sent.finish()
    expected = len(range(0, sent.num_sent, RATE_HZ // 50))
    assert len({*sent.times}) < expected - 50
    assert np.abs(np.diff(sent.faps, axis=0)).max() < 1000
