"""The order in which the recognizer accepts audio messages."""

import pytest

from kouxing.services.recognizer.audio_order import MAX_HELD_BYTES, WAIT_S, AudioOrder
from kouxing.shared.records import replace
from kouxing.shared.wire.audio import AudioChunk


def chunk(sequence: int, num_bytes: int = 2) -> AudioChunk:
    return AudioChunk(
        session="s", token="t", sequence=sequence, pcm=bytes(num_bytes), acknowledge=True
    )


def push(order: AudioOrder, *sequences: int) -> list[list[int]]:
    return [
        [message.sequence for message in order.push(chunk(number), 0.0)] for number in sequences
    ]


def test_starts_with_the_first_message_and_waits_for_missing_ones() -> None:
    assert push(AudioOrder(), 7, 8, 9) == [[7], [8], [9]]
    order = AudioOrder()
    assert push(order, 1, 4, 5, 4, 2, 3) == [[1], [], [], [], [2], [3, 4, 5]]
    assert order.last == 5


def test_does_not_wait_for_a_client_that_resends_nothing() -> None:
    order = AudioOrder()
    push(order, 1)
    message = replace(chunk(4), acknowledge=False)
    assert order.push(message, 0.0) == [message]


def test_continues_after_each_gap_that_is_not_filled_in_time() -> None:
    order = AudioOrder()
    push(order, 1, 4, 6)
    assert order.tick(WAIT_S * 0.9) == []
    assert [message.sequence for message in order.tick(WAIT_S)] == [4]
    assert order.tick(1.9 * WAIT_S) == []
    assert [message.sequence for message in order.tick(2 * WAIT_S)] == [6]


@pytest.mark.parametrize("num_bytes", [0, MAX_HELD_BYTES // 2])
def test_holds_limited_memory(num_bytes: int) -> None:
    order = AudioOrder()
    push(order, 1)
    num_held = 0
    while not order.push(chunk(3 + num_held, num_bytes), 0.0):
        num_held += 1
    assert num_held * (num_bytes + 200) < MAX_HELD_BYTES
