"""Fixtures for tests of control."""

from collections.abc import Iterator

import pytest

from kouxing.shared.network.bus import Bus
from kouxing.shared.network.sockets import Socket
from tests.control_harness import ControlHarness
from tests.fake_control import FakeControl


@pytest.fixture
def control() -> Iterator[FakeControl]:
    with FakeControl() as new_control:
        yield new_control


@pytest.fixture
def harness() -> Iterator[ControlHarness]:
    """Control without keys."""
    new_harness = ControlHarness(insecure=True)
    yield new_harness
    new_harness.close()


@pytest.fixture
def client(harness: ControlHarness) -> Iterator[Socket]:
    """Provide a socket at that control."""
    with Bus() as bus:
        yield bus.connect_dealer(harness.control.endpoints["commands"])
