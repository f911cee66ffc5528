"""Fixtures for tests of control."""

from collections.abc import Iterator

import pytest

from kouxing.shared.bus import Bus
from kouxing.shared.sockets import Socket
from tests.control_stage import Stage
from tests.fake_control import FakeControl


@pytest.fixture
def control() -> Iterator[FakeControl]:
    with FakeControl() as made:
        yield made


@pytest.fixture
def stage() -> Iterator[Stage]:
    """Control without keys."""
    made = Stage(insecure=True)
    yield made
    made.close()


@pytest.fixture
def client(stage: Stage) -> Iterator[Socket]:
    """Provide a socket at that control."""
    with Bus() as bus:
        yield bus.connect_dealer(stage.control.endpoints["commands"])
