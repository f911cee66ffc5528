"""The messages of a session that a new synthesizer receives."""

import math
from typing import cast

import pytest
from kouxing_client.messages import Message, Phone, Speech

from kouxing.services.recognizer.sessions.synthesizer_link import (
    KEPT_SAMPLES,
    MAX_BACKLOG,
    MAX_OVERDUE_S,
    SynthesizerLink,
)
from kouxing.shared.clock import to_samples
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import Peer
from kouxing.shared.network.reliable import ReliableReceiver
from kouxing.shared.network.sockets import Socket
from kouxing.shared.wire.events import split_batch
from kouxing.shared.wire.speech import Acknowledge, NewestFrame, Progress, Results

FAPS = bytes(range(4)) * NUM_FAPS


class FakeSynthesizerLink(SynthesizerLink):
    """A link to a synthesizer whose socket is a list."""

    def __init__(self) -> None:
        super().__init__()
        self.connect_to(1)

    def connect_to(self, epoch: int) -> list[Message]:
        """Connect to a new synthesizer; return the list of the messages that it receives."""
        self.sent: list[Message] = []
        socket = type("FakeSocket", (), {"send": lambda _, message: self._receive(message)})()
        self.connect(cast(Socket, socket), "s", epoch, 0.0)
        return self.sent

    def _receive(self, message: Message) -> None:
        self.sent += split_batch(cast(Results, message))

    def send_all(self, *messages: Message) -> None:
        for message in messages:
            self.send(message, 0.0)

    def acknowledge_up_to(self, sequence: int, frame: int = 0, epoch: int = 1) -> list[Message]:
        newest = NewestFrame(sequence=frame, media_time=320 * frame, values=FAPS)
        ack = Acknowledge(epoch=epoch, sequence=sequence, newest_frame=newest if frame else None)
        return self.acknowledge(ack, 0.0)


def progress(time_s: float) -> Progress:
    return Progress(media_time=to_samples(time_s), level_db=0.0)


def test_a_new_synthesizer_receives_the_newest_frame_and_the_last_messages() -> None:
    link = FakeSynthesizerLink()
    link.send_all(Speech(media_time=0, active=True), *[progress(number) for number in range(1, 8)])
    assert len(link.acknowledge_up_to(7, frame=40)) == 7
    resume, speech, *rest = link.connect_to(2)
    assert isinstance(resume, Progress)
    assert isinstance(speech, Speech)
    assert resume.newest_frame == NewestFrame(sequence=40, media_time=12_800, values=FAPS)
    times = [message.media_time for message in rest]
    assert times == [to_samples(number) for number in range(3, 8)]
    assert times[-2] - times[0] == KEPT_SAMPLES
    assert [message.sequence for message in (resume, speech, *rest)] == list(range(1, 8))
    assert {message.epoch for message in (resume, speech, *rest)} == {2}


def test_restarted_synthesizer_receives_the_last_messages_again() -> None:
    link = FakeSynthesizerLink()
    link.send_all(progress(1.0), progress(2.0))
    link.acknowledge_up_to(2, frame=40)
    acks: list[Acknowledge] = []
    socket = type("FakeSocket", (), {"send": lambda _, ack, to: acks.append(ack)})()
    restarted = ReliableReceiver(cast(Socket, socket), "s", Acknowledge)

    def deliver() -> list[int]:
        messages = link.sent[:]
        link.sent.clear()
        received = [message for message in messages if restarted.receive(message, Peer(b"r"))]
        return [message.media_time for message in received]

    link.sent.clear()
    link.send_all(progress(3.0), progress(4.0))
    assert deliver() == []
    assert [ack.sequence for ack in acks] == [0, 0], "only the first one has an effect"
    for ack in acks:
        assert link.acknowledge(ack, 0.0) == []
    assert deliver() == [12_800, *[to_samples(number) for number in (1.0, 2.0, 3.0, 4.0)]]
    link.send_all(progress(5.0))
    assert deliver() == [to_samples(5.0)]
    restarted.tick(math.inf)
    assert len(link.acknowledge(acks[-1], 0.0)) == 5
    assert link.backlog == 0


def test_forgets_messages_before_an_interruption() -> None:
    link = FakeSynthesizerLink()
    link.send_all(Speech(media_time=0, active=True), progress(1.0))
    link.acknowledge_up_to(2)
    link.forget()
    link.send_all(Speech(media_time=16_000, active=False))
    expected = Speech(session="s", epoch=2, sequence=1, media_time=16_000, active=False)
    assert link.connect_to(2) == [expected]


@pytest.mark.parametrize("is_acknowledged", [False, True])
def test_an_interruption_also_concerns_phones_that_are_on_their_way(
    *, is_acknowledged: bool
) -> None:
    link = FakeSynthesizerLink()
    phone = Phone(index=0, symbol="a", duration=1600, confidence=1.0, final=True)
    link.send_all(phone, progress(1.0))
    link.forget()
    if is_acknowledged:
        assert len(link.acknowledge_up_to(2)) == 2
    link.send_all(replace(phone, index=1), progress(2.0))
    received = link.connect_to(2)
    assert [message.index for message in received if isinstance(message, Phone)] == [1]
    assert received[-1].media_time == to_samples(2.0)
    link.forget()
    link.send_all(phone)
    assert link.connect_to(3)[-1].kind == phone.kind, "each synthesizer has its own numbers"


def test_drops_messages_only_while_the_synthesizer_is_too_slow() -> None:
    link = FakeSynthesizerLink()
    link.send_all(*[progress(0.0)] * (MAX_BACKLOG + 1))
    assert link.is_full, "audio waits"
    assert [link.check_overdue(time_s) for time_s in (1.0, 2.0, 1.1 + MAX_OVERDUE_S)] == [
        False,
        False,
        True,
    ]
    assert not link.is_full, "other sessions no longer wait"
    link.send_all(progress(1.0))
    assert len(link.acknowledge_up_to(MAX_BACKLOG + 1)) == MAX_BACKLOG + 1
    assert not link.check_overdue(20.0)
    link.send_all(progress(2.0))
    assert link.sent[-1].media_time == to_samples(2.0)
    assert link.backlog == 1
