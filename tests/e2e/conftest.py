"""A client of the running system, and another session that must go on whatever happens."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from kouxing_client import Client, Session

from kouxing.shared.bus import Bus
from kouxing.shared.keys import user_key
from tests.e2e.following import samples_of_file
from tests.system import DEMO, System


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
    """Another session, which must go on whatever happens to the tested one."""
    opened = client.open_session(encoding="f32le", paced=False)
    output = opened.frames()
    yield opened
    opened.push(samples_of_file(DEMO / "hello-female.wav")[:16000])
    end_s = time.monotonic() + 60
    num_frames = 0
    while num_frames < 40:
        assert time.monotonic() < end_s, "the other session does not go on"
        num_frames += len(list(output.available(0.1)))
    opened.close()
    system.assert_all_alive()
