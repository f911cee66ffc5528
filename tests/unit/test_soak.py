"""What the soak's figures are made of, without services."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import numpy as np
import pytest

from kouxing.evaluation.system.soak import RATE_HZ, Listener, Round, lost_phones, sound_of, summary
from kouxing.shared.bus import Received
from kouxing.shared.client import Session
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.wire.face import FapFrame
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import SessionOpened
from kouxing.shared.wire.speech import Phone

pytestmark = pytest.mark.unit


class _Session:
    """Says what it is given."""

    opened = SessionOpened(
        request="1", token="t", audio="a", phones="p", faps="f", events="e", frame_rate_hz=50.0
    )

    def __init__(self, messages: list[Message]) -> None:
        self._messages = messages

    def subscribe(self, *_kinds: type[Message]) -> _Session:
        return self

    def wait(self, _timeout_s: float) -> bool:
        return True

    def receive(self) -> Iterator[Received]:
        yield from map(Received, self._messages)


def _round(*messages: Message) -> tuple[list[str], int, int]:
    listener = Listener(cast(Session, _Session(list(messages))))
    listener.wait(0.0)
    return listener.take_round()


def _frame(media_time: int) -> FapFrame:
    return FapFrame(media_time=media_time, values=bytes(272), mask=bytes(9))


def _phone(index: int, symbol: str, *, final: bool = True, duration: int = 800) -> Phone:
    return Phone(index=index, symbol=symbol, duration=duration, confidence=1.0, final=final)


def test_frames_that_are_missing_or_come_twice_are_irregular() -> None:
    assert _round(_frame(0), _frame(320), _frame(640))[2] == 0
    assert _round(_frame(0), _frame(640))[2] == 1
    assert _round(_frame(0), _frame(0), _frame(320))[2] == 1


def test_phones_that_are_left_out_or_not_final_are_unfinished() -> None:
    whole = [_phone(0, "n", final=False), _phone(0, "n"), _phone(1, "i")]
    assert _round(*whole) == (["n", "i"], 0, 0)
    assert _round(_phone(0, "n"), _phone(2, "h"))[:2] == (["n", "h"], 1)
    assert _round(_phone(0, "n"), _phone(1, "i", final=False))[:2] == (["n"], 1)


def test_a_withdrawn_phone_is_none() -> None:
    assert _round(_phone(0, "n"), _phone(1, "sil", duration=0)) == (["n"], 0, 0)


def test_lost_phones_are_those_that_do_not_come_again() -> None:
    assert lost_phones(["n", "i", "h", "ao"], ["n", "i", "h", "ao"]) == 0
    assert lost_phones(["n", "i", "h", "ao"], ["n", "h", "ao", "a"]) == 1


def test_rounds_differ_but_for_two_in_ten() -> None:
    text = np.sin(np.cumsum(np.linspace(0.01, 1.0, 8000))).astype(np.float32)
    sounds = [sound_of(text, number) for number in range(22)]
    assert len({sound.tobytes() for sound in sounds}) == 1 + 16
    assert all(np.array_equal(sounds[0], sounds[number]) for number in (1, 10, 11, 20, 21))
    assert len({len(sound) for sound in sounds}) == 1
    assert len(sounds[0]) * MEDIA_RATE_HZ % RATE_HZ == 0, "rounds begin between samples"


def test_growth_is_taken_after_the_first_quarter() -> None:
    rounds = [
        Round(
            number=number,
            media_s=900.0 * (number + 1),
            wall_s=90.0 * (number + 1),
            drift=-3 if number == 5 else 0,
            num_irregular=1,
            num_phones=100,
            num_unfinished=0,
            num_lost=2 if number == 0 else None,
            memory_mb={"recognizer": 300.0 + (0 if number == 0 else 2 * number)},
        )
        for number in range(8)
    ]
    assert summary(rounds) == {
        "hours": 2.0,
        "times_real_time": 10.0,
        "largest_drift": 3.0,
        "irregular_frames": 8.0,
        "phones": 800.0,
        "unfinished_phones": 0.0,
        "lost_phones": 2.0,
        "recognizer_mb_per_hour": 8.0,
    }
