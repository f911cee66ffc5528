"""Audio messages in the order in which the recognizer takes them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from kouxing.services.recognizer.audio_order import MAX_HELD, WAIT_S, AudioOrder
from kouxing.shared.wire.audio import AudioChunk

pytestmark = pytest.mark.unit


def chunk(sequence: int, num_bytes: int = 2) -> AudioChunk:
    return AudioChunk(
        session="s", token="t", sequence=sequence, pcm=bytes(num_bytes), acknowledge=True
    )


def taken(order: AudioOrder, *sequences: int, now_s: float = 0.0) -> list[list[int]]:
    return [[each.sequence for each in order.accept(chunk(n), now_s)] for n in sequences]


def test_the_first_message_begins_and_the_others_follow() -> None:
    assert taken(AudioOrder(), 7, 8, 9) == [[7], [8], [9]]


def test_what_is_missing_is_waited_for() -> None:
    order = AudioOrder()
    assert taken(order, 1, 4, 5, 4, 2, 3) == [[1], [], [], [], [2], [3, 4, 5]]
    assert order.last == 5


def test_audio_of_a_client_that_sends_nothing_again_goes_on() -> None:
    order = AudioOrder()
    taken(order, 1)
    assert order.accept(replace(chunk(4), acknowledge=False), 0.0) == [
        replace(chunk(4), acknowledge=False)
    ]


def test_audio_goes_on_behind_a_hole_that_nobody_fills() -> None:
    order = AudioOrder()
    taken(order, 1, 4, 6)
    assert order.tick(WAIT_S * 0.9) == []
    assert [each.sequence for each in order.tick(WAIT_S)] == [4]
    assert order.tick(1.9 * WAIT_S) == [], "each hole has its own time"
    assert [each.sequence for each in order.tick(2 * WAIT_S)] == [6]


def test_little_is_held() -> None:
    order = AudioOrder()
    taken(order, 1)
    assert order.accept(chunk(3, MAX_HELD // 2), 0.0) == []
    big = order.accept(chunk(4, MAX_HELD // 2 + 1), 0.0)
    assert [each.sequence for each in big] == [3, 4]


def test_few_empty_messages_are_held() -> None:
    order = AudioOrder()
    taken(order, 1)
    num_held = 0
    while not order.accept(chunk(3 + num_held, 0), 0.0):
        num_held += 1
    assert num_held < 10_000
