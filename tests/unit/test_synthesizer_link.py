"""What a new synthesizer is told of a session, over real sockets."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from kouxing.services.recognizer.link import KEPT, SynthesizerLink
from kouxing.shared.bus import Bus, Socket
from kouxing.shared.clock import to_samples
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.speech import AcknowledgePhones, NewestFrame, Progress, ResumeFace, Speech

pytestmark = pytest.mark.unit
FAPS = bytes(range(4)) * NUM_FAPS


class Stage:
    """A link and two synthesizers' sockets."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.inputs = [bus.bind_router("tcp://127.0.0.1:*", "input") for _ in range(2)]
        self.link = SynthesizerLink()
        self.connect(0)

    def connect(self, synthesizer: int) -> None:
        socket = self.bus.connect_dealer(self.inputs[synthesizer].endpoint)
        self.link.connect(socket, "s", 1 + synthesizer, 0.0)

    def send(self, *messages: Message) -> None:
        for message in messages:
            self.link.send(message, 0.0)

    def acknowledge(self, sequence: int, frame: int = 0, epoch: int = 1) -> list[Message]:
        newest = NewestFrame(sequence=frame, media_time=320 * frame, values=FAPS)
        return self.link.acknowledge(
            AcknowledgePhones(
                epoch=epoch, sequence=sequence, newest_frame=newest if frame else None
            ),
            0.0,
        )


@pytest.fixture
def stage() -> Iterator[Stage]:
    with Bus() as bus:
        yield Stage(bus)


def taken(socket: Socket, count: int) -> list[Message]:
    messages: list[Message] = []
    while len(messages) < count:
        assert socket.wait(5.0)
        messages += [each.message for each in socket.receive() if isinstance(each.message, Message)]
    return messages


def progress(time_s: float) -> Progress:
    return Progress(media_time=to_samples(time_s), level_db=0.0)


def test_a_new_synthesizer_is_told_what_was_shown_and_the_last_messages(stage: Stage) -> None:
    stage.send(Speech(media_time=0, active=True), *[progress(number) for number in range(1, 8)])
    assert len(stage.acknowledge(7, frame=40)) == 7
    stage.connect(1)
    resume, speech, *rest = taken(stage.inputs[1], 7)
    assert (type(resume), type(speech)) == (ResumeFace, Speech)
    assert isinstance(resume, ResumeFace)
    assert resume.newest_frame == NewestFrame(sequence=40, media_time=12_800, values=FAPS)
    times = [each.media_time for each in rest]
    assert times == [to_samples(number) for number in range(3, 8)]
    assert times[-2] - times[0] == KEPT, "of those acknowledged the last 3 s, and the others"
    assert [each.sequence for each in (resume, speech, *rest)] == list(range(1, 8))
    assert {each.epoch for each in (resume, speech, *rest)} == {2}


def test_the_pose_of_a_face_that_showed_nothing_is_not_sent_again(stage: Stage) -> None:
    stage.send(progress(1.0))
    stage.acknowledge(1, frame=40)
    stage.connect(1)
    stage.acknowledge(0, epoch=2)
    taken(stage.inputs[1], 2)
    socket = stage.bus.connect_dealer(stage.inputs[0].endpoint)
    list(taken(stage.inputs[0], 1))
    stage.link.connect(socket, "s", 3, 0.0)
    resume, only = taken(stage.inputs[0], 2)
    assert isinstance(resume, ResumeFace)
    assert isinstance(only, Progress)


def test_acknowledgements_of_an_earlier_epoch_count_for_nothing(stage: Stage) -> None:
    stage.send(progress(1.0))
    stage.connect(1)
    assert stage.acknowledge(1, epoch=1) == []
    assert stage.link.backlog == 1


def test_what_came_before_an_interruption_is_forgotten(stage: Stage) -> None:
    stage.send(Speech(media_time=0, active=True), progress(1.0))
    stage.acknowledge(2)
    stage.link.forget()
    stage.send(Speech(media_time=16_000, active=False))
    stage.connect(1)
    (only,) = taken(stage.inputs[1], 1)
    assert only == Speech(session="s", epoch=2, sequence=1, media_time=16_000, active=False)
    assert not stage.inputs[1].wait(0.1)
