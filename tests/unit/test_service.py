"""The loop that every service runs."""

from __future__ import annotations

import errno
import time
from collections.abc import Iterator

import pytest

from shared.bus import Bus
from shared.config import ServiceConfig
from shared.keys import Peer
from shared.service import Service
from shared.wire.control import Heartbeat
from shared.wire.session import Done
from shared.wire.speech import Progress, Speech

pytestmark = pytest.mark.unit


class Slow(Service):
    """Takes 5 ms for a message; counts what its loop does."""

    name = "slow"
    role = "worker"

    def __init__(self) -> None:
        super().__init__(ServiceConfig(insecure=True), control=False)
        self.num_ticks = self.num_beats = self.num_handled = 0
        self.input = self.bus.bind_router("tcp://127.0.0.1:*", "slow.input")
        self.register(self.input, {Progress: self._on_progress})

    def on_tick(self, now_s: float) -> None:
        self.num_ticks += 1

    def on_heartbeat_due(self, heartbeat: Heartbeat) -> None:
        self.num_beats += 1

    def _on_progress(self, _progress: Progress, _sender: Peer) -> None:
        self.num_handled += 1
        time.sleep(0.005)


@pytest.fixture
def slow() -> Iterator[Slow]:
    service = Slow()
    yield service
    service.bus.close()


def handle(service: Slow, num_messages: int) -> None:
    end_s = time.monotonic() + 30
    while service.num_handled < num_messages:
        assert time.monotonic() < end_s
        service.step(0.01)


def test_a_flood_of_messages_does_not_stop_ticks_and_heartbeats(slow: Slow) -> None:
    with Bus() as bus:
        sender = bus.connect_dealer(slow.input.endpoint)
        for _ in range(300):
            sender.send(Progress(level_db=0.0))
        handle(slow, 300)
    assert slow.num_ticks > 10, "1.5 s of work"
    assert slow.num_beats >= 2


def test_what_is_not_expected_is_answered_counted_and_dropped(slow: Slow) -> None:
    with Bus() as bus:
        sender = bus.connect_dealer(slow.input.endpoint)
        sender.send(Speech(session="s", active=True))
        sender.send(Progress(level_db=0.0))
        handle(slow, 1)
        assert sender.wait(2.0)
        (answer,) = [received.message for received in sender.receive()]
    assert getattr(answer, "code", "") == "bad-message"
    assert slow.metrics.snapshot(0.0)["dropped_unexpected"] == 1


def test_a_paused_socket_keeps_its_messages(slow: Slow) -> None:
    with Bus() as bus:
        sender = bus.connect_dealer(slow.input.endpoint)
        slow.pause(slow.input, paused=True)
        sender.send(Progress(level_db=0.0))
        sender.send(Done(request="r"))
        for _ in range(10):
            slow.step(0.01)
        assert slow.num_handled == 0
        slow.pause(slow.input, paused=False)
        handle(slow, 1)


def test_a_message_for_which_no_file_can_be_opened_is_dropped(
    slow: Slow,
) -> None:
    handle_progress = slow._on_progress

    def open_nothing(progress: Progress, sender: Peer) -> None:
        handle_progress(progress, sender)
        if slow.num_handled == 1:
            raise OSError(errno.EMFILE, "Too many open files")

    slow._handlers[slow.input][Progress] = open_nothing
    with Bus() as bus:
        sender = bus.connect_dealer(slow.input.endpoint)
        for _ in range(2):
            sender.send(Progress(session="s", level_db=0.0))
        handle(slow, 2)


@pytest.mark.parametrize(("address", "warns"), [("10.0.0.1", True), ("127.0.0.1", False)])
def test_an_open_service_that_others_reach_says_so(
    slow: Slow, caplog: pytest.LogCaptureFixture, address: str, warns: bool
) -> None:
    slow.endpoints = {"input": f"tcp://{address}:5570"}
    slow.announce_ready()
    assert ("insecure = true" in caplog.text) == warns
