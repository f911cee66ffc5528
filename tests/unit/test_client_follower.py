"""A follower delivers each message of a session once, through moves and reconnections."""

from __future__ import annotations

import pytest
from kouxing_client import FapFrame, Sound
from kouxing_client.follower import CATCH_UP_S, MAX_HELD_FRAMES, OVERLAP_S, RETRY_S, Follower
from kouxing_client.messages import EndOfFaps, Joined, Message

from tests.fake_sockets import FakeConnection, FakeSockets

PHONES, FAPS, OTHER_FAPS = "phones", "faps", "other faps"


class FollowerHarness:
    """A follower of frames, sounds and the end, and its connections."""

    def __init__(self, epoch: int = 1) -> None:
        self.sockets = FakeSockets()
        self.received: list[Message] = []
        self.epochs: list[int] = []  # at each change
        self.follower = Follower(
            self.sockets,
            "s",
            (FapFrame, Sound, EndOfFaps),
            self.received.append,
            on_complete=lambda: None,
            on_new_epoch=lambda: self.epochs.append(self.follower.epoch),
        )
        self.start(epoch)

    def start(self, epoch: int, faps: str = FAPS) -> None:
        self.follower.start(epoch, {"phones": PHONES, "faps": faps})

    def complete(self) -> FollowerHarness:
        """Confirm the newest subscription."""
        for publisher in ("a", "b"):
            self.connection.on_message(Joined(publisher=publisher))
        return self

    @property
    def connection(self) -> FakeConnection:
        """The newest connection."""
        return self.sockets.connections[-1]

    def publish(self, *messages: Message) -> None:
        for message in messages:
            self.connection.on_message(message)


def frame(sequence: int, epoch: int = 1, media_time: int | None = None) -> FapFrame:
    time = 320 * sequence if media_time is None else media_time
    return FapFrame(
        epoch=epoch, sequence=sequence, media_time=time, packed_values=bytes(272), mask=bytes(9)
    )


def sound(sequence: int, epoch: int = 1) -> Sound:
    return Sound(epoch=epoch, sequence=sequence, pcm=b"\0\0")


def test_subscribes_again_until_every_publisher_confirms() -> None:
    harness = FollowerHarness()
    first = harness.connection
    for _ in range(2):
        first.on_message(Joined(publisher="a"))
    assert not harness.follower.is_complete, "only one has confirmed"
    harness.sockets.now_s += RETRY_S
    harness.follower.tick()
    assert not first.is_open
    assert harness.connection is not first
    harness.complete()
    harness.sockets.now_s += 10 * RETRY_S
    harness.follower.tick()
    assert len(harness.sockets.connections) == 2


def test_misses_no_repeated_message_if_a_newer_one_arrives_before_the_confirmation() -> None:
    harness = FollowerHarness()
    harness.publish(frame(3), sound(8))
    assert harness.received == []
    harness.publish(Joined(publisher="a", endpoint="faps", repeats=True))
    harness.publish(*map(frame, (1, 2, 3, 4)))
    assert harness.received == [frame(number) for number in (1, 2, 3, 4)]
    harness.publish(Joined(publisher="b", endpoint="phones"))  # it repeats nothing
    assert harness.received[4:] == [sound(8)]


def test_accepts_messages_of_a_publisher_that_does_not_confirm() -> None:
    harness = FollowerHarness()
    harness.publish(frame(3), sound(8))
    harness.sockets.now_s += RETRY_S
    harness.follower.tick()
    assert harness.received == [sound(8), frame(3)]


def test_follows_a_move_to_another_publisher() -> None:
    harness = FollowerHarness().complete()
    old = harness.connection
    harness.publish(EndOfFaps(epoch=1))
    assert harness.follower.has_ended
    harness.start(2, OTHER_FAPS)
    assert not harness.follower.is_complete
    harness.complete()
    harness.received.clear()
    left_over = frame(2, epoch=1)
    harness.publish(frame(1, epoch=2), left_over, frame(2, epoch=2))
    assert harness.received == [frame(1, epoch=2), frame(2, epoch=2)]
    assert harness.epochs == [2]
    assert not harness.follower.has_ended
    assert harness.follower.num_outdated == 1
    assert old.is_open, "the publisher of phones is still connected there"
    harness.sockets.now_s += OVERLAP_S
    harness.follower.tick()
    assert not old.is_open


def test_drops_copies_from_a_second_connection() -> None:
    harness = FollowerHarness().complete()
    old = harness.connection
    for _ in range(2):  # it connects again, and once more before that is complete
        harness.start(1)
    assert sum(connection.is_open for connection in harness.sockets.connections) == 2
    harness.complete()
    for connection, number in (
        (old, 1),
        (old, 3),
        (harness.connection, 2),
        (harness.connection, 3),
    ):
        connection.on_message(sound(number))
    old.unread.append(sound(4))
    harness.sockets.now_s += OVERLAP_S
    harness.follower.tick()
    assert harness.received == [sound(number) for number in (1, 3, 2, 4)]


def test_drops_what_a_publisher_repeats_for_others() -> None:
    harness = FollowerHarness().complete()
    harness.publish(*map(sound, (1, 2, 1, 2, 3)))
    assert harness.received == [sound(1), sound(2), sound(3)]


def test_a_new_epoch_of_one_publisher_drops_nothing_of_another() -> None:
    harness = FollowerHarness().complete()
    harness.publish(frame(1, epoch=2), sound(1, epoch=1))
    assert harness.received == [frame(1, epoch=2), sound(1, epoch=1)]
    assert harness.follower.epoch == 2


def test_a_publisher_may_report_a_new_epoch_before_control_does() -> None:
    harness = FollowerHarness().complete()
    harness.publish(frame(5), frame(8), EndOfFaps(epoch=1), frame(9, epoch=2))
    assert harness.follower.num_missed == 2
    assert harness.epochs == [2]
    assert not harness.follower.has_ended
    harness.start(2)
    assert harness.epochs == [2]


def test_drops_old_live_frames_after_the_process_was_suspended() -> None:
    harness = FollowerHarness().complete()
    frames = [frame(number) for number in range(1, 31)]
    harness.publish(frames[0])
    harness.sockets.resumed_at_s = harness.sockets.now_s
    harness.publish(*frames[1:-1])
    assert harness.received == frames[:1]
    harness.sockets.now_s += CATCH_UP_S
    harness.publish(frames[-1])
    assert harness.received == [frames[0], *frames[-1 - MAX_HELD_FRAMES :]]
    assert harness.follower.num_missed == 28 - MAX_HELD_FRAMES


@pytest.mark.parametrize("is_closed", [False, True])
def test_delivers_the_last_frames_after_a_suspension_unless_it_is_closed(is_closed: bool) -> None:
    harness = FollowerHarness().complete()
    harness.sockets.resumed_at_s = harness.sockets.now_s
    harness.publish(frame(1))
    assert harness.follower.tick() == harness.sockets.now_s + CATCH_UP_S
    assert harness.received == []
    if is_closed:
        harness.follower.close()
    harness.sockets.now_s += CATCH_UP_S
    harness.follower.tick()
    assert harness.received == ([] if is_closed else [frame(1)])
