"""The acknowledged stream over a real pair of sockets, with losses made on purpose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from kouxing.shared.bus import Bus, Socket
from kouxing.shared.keys import Peer
from kouxing.shared.reliable import RESEND_AFTER_S, ReliableReceiver, ReliableSender
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.speech import AcknowledgePhones, NewestFrame, Progress

pytestmark = pytest.mark.unit


class Link:
    """A sender and a receiver of one session, joined by real sockets."""

    def __init__(self, bus: Bus) -> None:
        self.router = bus.bind_router("tcp://127.0.0.1:*", "router")
        self.dealer = bus.connect_dealer(self.router.endpoint)
        self.sender = ReliableSender(self.dealer, "s", 1)
        self.receiver = ReliableReceiver(self.router, "s")
        self.taken: list[int] = []

    def carry(self, num_expected: int, *, lose: tuple[int, ...] = ()) -> None:
        """Let so many messages arrive, losing those with the given numbers."""
        for message, sender in arriving(self.router, num_expected):
            if message.sequence not in lose and self.receiver.accept(message, sender):
                self.taken.append(message.sequence)

    def acknowledge(self, now_s: float) -> None:
        self.receiver.tick()
        while self.dealer.wait(0.2):
            for received in self.dealer.receive():
                assert isinstance(received.message, AcknowledgePhones)
                self.sender.acknowledge(received.message.sequence, now_s)


def arriving(socket: Socket, num_expected: int) -> Iterator[tuple[Message, Peer]]:
    count = 0
    while count < num_expected:
        assert socket.wait(2.0), f"only {count} of {num_expected} messages arrived"
        for received in socket.receive():
            assert isinstance(received.message, Message)
            count += 1
            yield received.message, received.sender


@pytest.fixture
def link() -> Iterator[Link]:
    with Bus() as bus:
        yield Link(bus)


def send(link: Link, count: int) -> None:
    for _ in range(count):
        link.sender.send(Progress(level_db=0.0), now_s=0.0)


def test_each_message_arrives_once_and_in_order(link: Link) -> None:
    send(link, 5)
    link.carry(5)
    assert link.taken == [1, 2, 3, 4, 5]
    link.acknowledge(0.0)
    assert link.sender.backlog == 0


def test_what_was_lost_is_sent_again(link: Link) -> None:
    send(link, 5)
    link.carry(5, lose=(3,))
    assert link.taken == [1, 2]
    link.acknowledge(0.0)
    assert link.sender.backlog == 3
    assert link.sender.tick(RESEND_AFTER_S / 2) == 0
    assert link.sender.tick(RESEND_AFTER_S) == 3
    link.carry(3)
    assert link.taken == [1, 2, 3, 4, 5]


def test_repeats_are_ignored(link: Link) -> None:
    send(link, 2)
    link.carry(2)
    link.sender.tick(RESEND_AFTER_S)
    link.carry(2)
    assert link.taken == [1, 2]


def test_a_greater_epoch_starts_anew_and_an_older_one_is_ignored(link: Link) -> None:
    send(link, 3)
    link.carry(3)
    newer = ReliableSender(link.dealer, "s", 2)
    newer.send(Progress(level_db=0.0), now_s=0.0)
    link.carry(1)
    assert link.taken == [1, 2, 3, 1]
    link.sender.send(Progress(level_db=0.0), now_s=0.0)
    link.carry(1)
    assert link.taken == [1, 2, 3, 1]


def test_what_the_receiver_adds_goes_with_every_acknowledgement(link: Link) -> None:
    frame = NewestFrame(sequence=2, media_time=320, values=bytes(272))
    told = AcknowledgePhones(newest_frame=frame)
    receiver = ReliableReceiver(link.router, "s", lambda: told)
    receiver.acknowledge()  # to nobody yet
    send(link, 1)
    for message, sender in arriving(link.router, 1):
        assert receiver.accept(message, sender)
    receiver.acknowledge()
    for message, _ in arriving(link.dealer, 1):
        assert message == replace(told, session="s", epoch=1, sequence=1)
