"""A follower over real sockets: confirmations, restarts, missed frames, the end."""

from __future__ import annotations

import dataclasses
import socket
import time
from collections.abc import Callable, Iterator

import pytest

from kouxing.shared import follower
from kouxing.shared.bus import Bus, Socket
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MASK_BYTES, NUM_FAPS
from kouxing.shared.follower import PollingLoop, SessionFollower
from kouxing.shared.wire.audio import Sound
from kouxing.shared.wire.face import EndOfFaps, FapFrame
from kouxing.shared.wire.message import Message
from tests.raw_bytes import answer_handshake

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


def test_it_follows_where_something_else_answered_before(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(follower, "UNCONFIRMED_S", 0.5)
    listener = socket.create_server(("127.0.0.1", 0))
    faps = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    studio.follower.start(1, {"phones": studio.phones.endpoint, "faps": faps})
    answer_handshake(listener, False, b"\x00\x05hello")
    studio.faps = studio.bus.bind_publisher(faps, "faps")
    studio.complete()
    studio.faps.send(frame(1))
    studio.step_until(lambda: studio.received == [frame(1)])
    assert studio.num_completed == 1
    assert not studio.loop.at_each_step


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
    studio.complete()
    assert studio.num_completed == 2
    studio.received.clear()
    studio.other_faps.send(frame(1, epoch=2))
    studio.step_until(lambda: bool(studio.received))
    studio.other_faps.send(frame(2, epoch=1))  # left over from before the restart
    studio.faps.send(frame(7))  # where it was published before
    studio.other_faps.send(frame(2, epoch=2))
    studio.step_until(lambda: len(studio.received) > 1)
    assert studio.received == [frame(1, epoch=2), frame(2, epoch=2)]
    assert studio.epochs == [2]
    assert not studio.follower.has_ended
    assert studio.follower.num_missed == 0


def test_nothing_is_missed_or_taken_twice_while_a_session_moves(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    studio.received.clear()
    sounds = [Sound(session="one", epoch=1, sequence=1 + n, pcm=b"\0\0") for n in range(4)]
    studio.phones.send(sounds[0])  # still under way when the move is told
    studio.start(2, studio.other_faps)
    studio.phones.send(sounds[1])
    while not studio.follower._confirmed:  # from here on phones come both ways
        list(studio.phones.receive())
        studio.loop.step(0.01)
    studio.phones.send(sounds[2])
    studio.complete()
    studio.phones.send(sounds[3])
    studio.step_until(lambda: sounds[3] in studio.received)
    assert studio.received == sounds


def test_one_publishers_new_epoch_drops_nothing_of_another(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    studio.faps.send(frame(1, epoch=2))  # read before the sound that came sooner
    studio.step_until(lambda: len(studio.received) == 1)
    late = Sound(session="one", epoch=1, sequence=1, pcm=b"\0\0")
    studio.phones.send(late)
    studio.step_until(lambda: len(studio.received) == 2)
    assert studio.received[1] == late
    assert studio.follower.epoch == 2


def test_what_the_connection_before_still_brings_is_taken_once(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    studio.start(1)  # at the same addresses: the connection may be dead
    studio.complete()
    sounds = [Sound(session="one", epoch=1, sequence=1 + n, pcm=b"\0\0") for n in range(3)]
    for sound in (sounds[0], sounds[2], sounds[1]):  # both ways, and one late
        studio.phones.send(sound)
    studio.step_until(lambda: len(studio.received) == 3)
    assert studio.received == [sounds[0], sounds[2], sounds[1]]
    studio.follower._leave_s = 0.0
    studio.phones.send(dataclasses.replace(sounds[0], sequence=4))
    studio.step_until(lambda: len(studio.received) == 4)
    assert studio.follower._socket_before is None


def test_what_works_is_kept_until_the_other_does(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    for _ in range(2):  # it connects again, and once more before that is in effect
        studio.start(1)
    sound = Sound(session="one", epoch=1, sequence=1, pcm=b"\0\0")
    studio.phones.send(sound)  # nobody else has subscribed yet
    studio.complete()
    studio.step_until(lambda: bool(studio.received))
    assert studio.received == [sound]


def test_what_the_publisher_that_stays_sent_before_a_move_still_comes(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    studio.start(2, studio.other_faps)
    studio.complete()
    assert studio.follower._socket_before is not None
    assert studio.follower._leave_s > time.monotonic() + follower.KEPT_S / 2


def test_what_waited_while_the_process_was_stopped_is_left_but_for_the_newest(
    studio: Studio,
) -> None:
    studio.start(1)
    studio.complete()
    frames = [dataclasses.replace(frame(n, 1), media_time=320 * n) for n in range(1, 31)]
    studio.faps.send(frames[0])
    studio.step_until(lambda: len(studio.received) == 1)
    studio.loop.stall.resumed_at_s = time.monotonic()
    for each in frames[1:-1]:
        studio.faps.send(each)
    end_s = time.monotonic() + 2 * follower.CATCH_UP_S
    studio.step_until(lambda: time.monotonic() > end_s)
    assert len(studio.received) == 1
    studio.faps.send(frames[-1])
    studio.step_until(lambda: frames[-1] in studio.received)
    assert studio.received == [frames[0], *frames[-1 - follower.MAX_OLD :]]
    assert studio.follower.num_missed == 28 - follower.MAX_OLD


def test_a_frame_that_is_made_again_in_a_new_epoch_is_taken_once(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    frames = [
        dataclasses.replace(frame(sequence, epoch), media_time=media_time)
        for sequence, epoch, media_time in ((1, 1, 0), (2, 1, 320), (2, 2, 320), (3, 2, 640))
    ]
    for each in frames:
        studio.faps.send(each)
    studio.step_until(lambda: frames[-1] in studio.received)
    assert studio.received == [frames[0], frames[1], frames[3]]


def test_a_publisher_may_tell_of_a_restart_before_control_does(studio: Studio) -> None:
    studio.start(1)
    studio.complete()
    studio.faps.send(frame(8))
    studio.faps.send(EndOfFaps(session="one", epoch=1))
    studio.faps.send(frame(9, epoch=2))
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
