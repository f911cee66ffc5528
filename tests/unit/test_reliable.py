"""The acknowledged stream from recognizer to synthesizer, with messages that are lost."""

import math
from collections import deque
from typing import Any, cast

from kouxing_client.messages import Message

from kouxing.shared.network.peer import Peer
from kouxing.shared.network.reliable import (
    ACKNOWLEDGE_INTERVAL_S,
    MAX_UNACKNOWLEDGED_S,
    RESEND_AFTER_S,
    ReliableReceiver,
    ReliableSender,
)
from kouxing.shared.wire.events import split_batch
from kouxing.shared.wire.speech import Acknowledge, NewestFrame, Progress, Results

PEER = Peer(b"peer")
FRAME = NewestFrame(sequence=2, media_time=320, values=bytes(272))


class FakeSocket:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: deque[Message] = deque()

    def send(self, message: Message, **_: object) -> bool:
        self.sent.append(message)
        return True


class ReliablePair:
    """A sender and a receiver of one session."""

    def __init__(self) -> None:
        self.dealer, self.router = FakeSocket(), FakeSocket()
        self.sender = self.make_sender(epoch=1)
        self.receiver = ReliableReceiver(
            cast(Any, self.router), "s", lambda: Acknowledge(newest_frame=FRAME)
        )
        self.received: list[int] = []

    def make_sender(self, epoch: int) -> ReliableSender:
        return ReliableSender(cast(Any, self.dealer), "s", epoch)

    def send(self, count: int) -> None:
        for _ in range(count):
            self.sender.send(Progress(level_db=0.0), now_s=0.0)

    def deliver(self, *, lose: tuple[int, ...] = ()) -> None:
        """Deliver what was sent, except messages of some numbers."""
        while self.dealer.sent:
            for message in split_batch(cast(Results, self.dealer.sent.popleft())):
                if message.sequence not in lose and self.receiver.receive(message, PEER):
                    self.received.append(message.sequence)

    def acknowledge(self) -> None:
        self.receiver.tick(math.inf)
        while self.router.sent:
            self.sender.acknowledge(self.router.sent.popleft().sequence, 0.0)


def test_resends_lost_messages_and_delivers_each_once_and_in_order() -> None:
    link = ReliablePair()
    link.send(5)
    link.deliver(lose=(3,))
    assert link.received == [1, 2]
    link.acknowledge()
    assert [message.sequence for message in link.sender.unacknowledged] == [3, 4, 5]
    assert link.sender.tick(RESEND_AFTER_S / 2) == 0
    assert link.sender.tick(RESEND_AFTER_S) == 3
    link.deliver()
    assert link.received == [1, 2, 3, 4, 5]
    link.acknowledge()
    assert not link.sender.unacknowledged


def test_a_new_epoch_starts_again_and_old_ones_are_ignored() -> None:
    link = ReliablePair()
    link.send(3)
    link.deliver()
    link.make_sender(epoch=2).send(Progress(level_db=0.0), now_s=0.0)
    link.send(1)
    link.deliver()
    assert link.received == [1, 2, 3, 1]


def test_the_lost_first_message_of_an_epoch_is_resent() -> None:
    link = ReliablePair()
    link.send(3)
    link.deliver()
    link.sender = link.make_sender(epoch=2)
    link.send(3)
    link.deliver(lose=(1,))
    assert link.received == [1, 2, 3]
    link.acknowledge()
    assert link.sender.tick(RESEND_AFTER_S) == 3
    link.deliver()
    assert link.received == [1, 2, 3, 1, 2, 3]


def test_ended_session_does_not_hide_its_successor() -> None:
    ended, link = ReliablePair(), ReliablePair()
    ended.send(5)
    for message in list(ended.dealer.sent)[3:]:
        link.dealer.send(message)
    link.send(2)
    link.deliver()
    link.acknowledge()
    assert link.received == [1, 2]


def test_acknowledges_at_intervals_until_everything_is_acknowledged() -> None:
    link = ReliablePair()
    link.send(1)
    link.deliver()
    assert link.receiver.tick(10.0) == math.inf
    link.send(1)
    link.deliver()
    assert link.receiver.tick(10.01) == 10.0 + MAX_UNACKNOWLEDGED_S
    assert len(link.router.sent) == 1
    assert link.receiver.tick(10.0 + ACKNOWLEDGE_INTERVAL_S) == math.inf
    assert [message.sequence for message in link.router.sent] == [1, 2]
