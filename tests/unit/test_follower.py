"""A follower over real sockets: confirmations, restarts, missed frames, the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from shared.bus import Bus, Socket
from shared.errors import UserError
from shared.face.faps import MASK_BYTES, NUM_FAPS
from shared.follower import PollingLoop, SessionFollower
from shared.wire.audio import Sound
from shared.wire.face import EndOfFaps, FapFrame
from shared.wire.message import Message

pytestmark = pytest.mark.unit

LOCAL = "tcp://127.0.0.1:*"


class Studio:
    """A publisher of phones, two of FAPs, and a follower of the session "one" in a loop."""

    def __init__(self, *kinds: type[Message]) -> None:
        self.bus = Bus()
        self.phones = self.bus.bind_publisher(LOCAL, "phones")
        self.faps = self.bus.bind_publisher(LOCAL, "faps")
        self.other_faps = self.bus.bind_publisher(LOCAL, "faps")
        self.loop = PollingLoop(self.bus)
        self.received: list[Message] = []
        self.num_completed = 0
        self.epochs: list[int] = []  # at each restart
        self.follower = SessionFollower(
            self.loop,
            "one",
            dict.fromkeys(kinds, self.received.append),
            on_complete=self._on_complete,
            on_restart=lambda: self.epochs.append(self.follower.epoch),
        )

    def start(self, epoch: int, faps: Socket | None = None) -> None:
        faps = faps or self.faps
        self.follower.start(epoch, {"phones": self.phones.endpoint, "faps": faps.endpoint})

    def step_until(self, condition: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < end_s
            for publisher in (self.phones, self.faps, self.other_faps):
                list(publisher.receive())  # answers subscriptions
            self.loop.step(0.01)

    def complete(self) -> None:
        self.step_until(lambda: self.follower.is_complete)

    def _on_complete(self) -> None:
        self.num_completed += 1


@pytest.fixture
def studio() -> Iterator[Studio]:
    studio = Studio(FapFrame, EndOfFaps, Sound)
    yield studio
    studio.follower.close()
    studio.bus.close()


def frame(sequence: int, epoch: int = 1, session: str = "one") -> FapFrame:
    return FapFrame(
        session=session,
        epoch=epoch,
        sequence=sequence,
        values=bytes(4 * NUM_FAPS),
        mask=bytes(MASK_BYTES),
    )


def test_it_is_complete_when_every_publisher_has_confirmed(studio: Studio) -> None:
    studio.start(1)
    end_s = time.monotonic() + 60
    while not list(studio.faps.receive()) and not studio.loop.step(0.01):
        assert time.monotonic() < end_s
    assert not studio.follower.is_complete, "the phones' publisher has not confirmed"
    studio.complete()
    assert studio.num_completed == 1


def test_one_kind_needs_its_own_publisher_alone() -> None:
    studio = Studio(FapFrame)
    studio.follower.start(1, {"faps": studio.faps.endpoint})
    studio.complete()
    studio.bus.close()


def test_from_confirmation_on_nothing_is_missed_and_other_sessions_stay_out(
    studio: Studio,
) -> None:
    studio.start(1)
    studio.complete()
    sent = [frame(1), frame(2), Sound(session="one", epoch=1, pcm=b"\0\0")]
    for message in (frame(1, session="two"), *sent):
        (studio.phones if isinstance(message, Sound) else studio.faps).send(message)
    studio.step_until(lambda: len(studio.received) == 3)
    assert sorted(map(repr, studio.received)) == sorted(map(repr, sent))


def test_missed_frames_are_counted(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    for sequence in (5, 6, 9, 10, 12):
        studio.faps.send(frame(sequence))
    studio.step_until(lambda: len(studio.received) == 5)
    assert studio.follower.num_missed == 3
    assert studio.loop.metrics.snapshot(1.0)["frames_missed"] == 3


def test_a_session_that_moved_is_followed_to_its_new_publisher(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    studio.faps.send(EndOfFaps(session="one", epoch=1))
    studio.step_until(lambda: studio.follower.has_ended)

    studio.start(2, studio.other_faps)
    assert not studio.follower.is_complete
    assert not studio.follower.has_ended
    studio.complete()
    assert studio.epochs == [2]
    assert studio.num_completed == 2
    studio.received.clear()
    studio.faps.send(frame(7))  # where it was published before
    studio.other_faps.send(frame(1, epoch=1))  # left over from before the restart
    studio.other_faps.send(frame(1, epoch=2))
    studio.step_until(lambda: bool(studio.received))
    assert studio.received == [frame(1, epoch=2)]
    assert studio.follower.num_missed == 0


def test_a_publisher_may_tell_of_a_restart_before_control_does(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    studio.faps.send(frame(8))
    studio.faps.send(EndOfFaps(session="one", epoch=1))
    studio.faps.send(frame(1, epoch=2))
    studio.step_until(lambda: len(studio.received) == 3)
    assert studio.epochs == [2]
    assert not studio.follower.has_ended
    studio.start(2)
    assert studio.epochs == [2], "the same restart is told once"


def test_an_unknown_epoch_is_taken_from_the_first_message(studio: Studio) -> None:
    studio.start(0)
    studio.complete()
    studio.faps.send(frame(1, epoch=4))
    studio.step_until(lambda: bool(studio.received))
    assert studio.follower.epoch == 4
    assert studio.epochs == []


def test_after_close_nothing_comes(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    studio.faps.send(frame(1))
    studio.follower.close()
    assert not studio.follower.is_complete
    assert not studio.loop.step(0.05)
    assert not studio.received


def test_a_missing_endpoint_is_named(studio: Studio) -> None:
    with pytest.raises(UserError, match="session one: no endpoint is named for 'phones'"):
        studio.follower.start(1, {"faps": studio.faps.endpoint})
