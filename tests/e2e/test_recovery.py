"""A service that crashes or hangs is restarted, and its sessions continue."""

import io
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from kouxing_client import Client
from rich.console import Console

from kouxing.services.cli.supervisor import Supervisor
from kouxing.shared.errors import UserError
from tests.e2e.following import Stream, samples_of_file, stream
from tests.system import CHEAP, DEMO, System, wait_until

SERVICES = ("control", "recognizer", "synthesizer", "driver")


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    folder = tmp_path_factory.mktemp("supervised")
    with System(SERVICES, folder, CHEAP, restarts=True) as running:
        yield running


@pytest.mark.parametrize(
    ("service", "blow", "text"),
    [
        ("recognizer", signal.SIGSTOP, "recognizer hangs"),
        ("synthesizer", signal.SIGKILL, "synthesizer ended with status -9"),
    ],
)
def test_a_session_continues_after_its_only_worker_hangs_or_crashes(
    system: System, service: str, blow: signal.Signals, text: str
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:48000]
    undisturbed = stream(system.control, samples)
    with Client(system.control) as client, client.open_session(encoding="f32le") as session:
        sent = Stream(session)
        sent.send(samples[:24000], paced=True)
        failed = system.process(service)
        failed.send_signal(blow)
        sent.send(samples[24000:], paced=True)
        sent.finish()
        assert system.process(service) is not failed
    assert text in system.console.getvalue()
    assert {*undisturbed.times} <= {*sent.times}


def test_the_driver_is_restarted(system: System) -> None:
    def drivers() -> set[str]:
        return {state.instance for state in system.status().services if state.service == "driver"}

    before = drivers()
    system.process("driver").kill()
    wait_until(lambda: drivers() - before)
    wait_until(lambda: "driver is running again" in system.console.getvalue())


def test_a_wrong_configuration_ends_the_wait(tmp_path: Path) -> None:
    arguments = ["--config", str(tmp_path / "absent.toml")]
    supervisor = Supervisor(
        arguments, tmp_path, Console(file=io.StringIO()), services=("synthesizer",)
    )
    try:
        supervisor.start()
        supervisor.watch()
        with pytest.raises(UserError, match=r"synthesizer: .*absent\.toml"):
            supervisor.wait()
    finally:
        supervisor.stop()
