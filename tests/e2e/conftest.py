"""A client of the running system, and another session that no test may disturb."""

from collections.abc import Iterator

import pytest
from kouxing_client import Client, Session

from kouxing.shared.bus import Bus
from kouxing.shared.keys import user_key
from tests.e2e.following import samples_of_file
from tests.system import DEMO, System, wait_until


@pytest.fixture
def client(system: System) -> Iterator[Client]:
    with Client(system.control) as made:
        yield made


@pytest.fixture
def bus() -> Iterator[Bus]:
    """Sockets with the client's key, for messages that no client sends."""
    with Bus(user_key()) as made:
        yield made


@pytest.fixture
def witness(system: System, client: Client) -> Iterator[Session]:
    """Another session, which must continue after the test."""
    with client.open_session(encoding="f32le", paced=False) as opened:
        output = opened.frames()
        yield opened
        opened.push(samples_of_file(DEMO / "hello-female.wav")[:16000])
        wait_until(lambda: any(frame.media_time > 12000 for frame in output.available(0.1)))
    system.assert_all_alive()
