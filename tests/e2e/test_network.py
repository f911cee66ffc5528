"""Control, recognizer, synthesizer and client on a host each, with keys of their own.

The hosts are network namespaces; where they are forbidden, these tests are skipped.
"""

import functools
import time
from collections.abc import Callable, Iterator

import pytest
from kouxing_client import Client

from kouxing.evaluation.system.live import ReceivedResults, speak, speak_undisturbed
from kouxing.evaluation.system.network import NetworkLink
from kouxing.evaluation.system.systems import ON_HOSTS, SPARE, HostsSystem
from kouxing.shared.settings.keys import CLIENT
from tests.containers import network_or_skip
from tests.system import DEMO, LIGHT_MODEL, SKIP_NO_AUDIO, samples_of_file

CUT_AT_S = 1.0
SAMPLES = samples_of_file(DEMO / "hello-female.wav")[:56000]


LOST_AFTER = {"KOUXING_CONTROL_LOST_AFTER_S": "5"}  # a busy service is not lost


@pytest.fixture(scope="module")
def _complete() -> Iterator[None]:
    """Let services process everything on a busy machine."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (SKIP_NO_AUDIO | LOST_AFTER | LIGHT_MODEL).items():
            patch.setenv(name, value)
        yield


@pytest.fixture(scope="module")
def system(_complete: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[HostsSystem]:
    """Services on hosts whose links delay and lose packets, with a second recognizer."""
    folder = tmp_path_factory.mktemp("hosts")
    states = folder / "states"
    states.mkdir()
    with (
        network_or_skip(
            [*ON_HOSTS, CLIENT, SPARE], NetworkLink(delay_ms=10.0, loss=0.02)
        ) as network,
        HostsSystem(folder, states, network, "recognizer") as system,
        system.on_client(),
    ):
        yield system


@pytest.fixture(scope="module")
def client(system: HostsSystem) -> Iterator[Client]:
    with Client(system.control, key=system.key) as client:
        yield client


@pytest.fixture(scope="module")
def expected(client: Client) -> ReceivedResults:
    return speak_undisturbed(client, SAMPLES)


@pytest.fixture(autouse=True)
def _longer_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kouxing.evaluation.system.live.END_TIMEOUT_S", 60.0)


def stream_live(
    client: Client, system: HostsSystem, host: str = "", *, cut_s: float = 120.0
) -> ReceivedResults:
    """Stream in real time, and cut off a host: that of a service, or the client's."""
    session = client.open_session(encoding="f32le")
    begin_s = time.monotonic()
    if host and host != CLIENT:
        host = system.instance_of(session.name, host)
    steps: list[tuple[float, Callable[[], object]]] = [
        (CUT_AT_S, functools.partial(system.network.cut, host)),
        (CUT_AT_S + cut_s, system.network.restore),
    ]

    def on_step() -> None:
        if host and steps and time.monotonic() > begin_s + steps[0][0]:
            steps.pop(0)[1]()

    (received,) = speak([session], SAMPLES, on_step=on_step)
    session.close()
    system.network.restore()
    assert received.ended, received.error
    return received


def symbols(received: ReceivedResults, since: int = 0) -> list[str]:
    return [item.symbol for item in received.spoken_phones() if item.media_time >= since]


def assert_same(received: ReceivedResults, expected: ReceivedResults, since: int = 0) -> None:
    """Compare phones and frames from some media time on."""
    assert symbols(received, since) == symbols(expected, since)
    assert len(symbols(received, since)) > 10
    times = [{frame.media_time for _, frame in results.frames} for results in (received, expected)]
    assert {time for time in times[1] if time >= since} <= times[0]


def test_results_are_equal_over_a_bad_network(
    system: HostsSystem, client: Client, expected: ReceivedResults
) -> None:
    assert_same(stream_live(client, system), expected)


def test_a_client_that_was_cut_off_catches_up(
    system: HostsSystem, client: Client, expected: ReceivedResults
) -> None:
    """Frames from before the cut may be lost, but none of the client's audio is."""
    received = stream_live(client, system, CLIENT, cut_s=2.0)
    assert_same(received, expected, since=round(CUT_AT_S * 16000))
    assert {frame.epoch for _, frame in received.frames} == {1}


def test_a_session_continues_when_a_host_falls_silent(
    system: HostsSystem, client: Client, expected: ReceivedResults
) -> None:
    """No service is notified that the connections are gone."""
    received = stream_live(client, system, "recognizer")
    assert {frame.epoch for _, frame in received.frames} == {1, 2}
    assert_same(received, expected)
