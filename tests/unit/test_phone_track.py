"""Each phone of a session counts once, even if several recognizers publish it."""

from typing import Any

import pytest
from kouxing_client import Phone, Speech
from kouxing_client.messages import SILENCE
from kouxing_client.phone_track import PhoneTrack


def phone(symbol: str, index: int, onset: int, **changes: Any) -> Phone:
    fields = {"epoch": 1, "duration": 100, "confidence": 1.0, "final": True} | changes
    return Phone(symbol=symbol, index=index, media_time=onset, **fields)


def restart(track: PhoneTrack, time: int, *, active: bool = True) -> list[tuple[str, int]]:
    """Continue at another recognizer; return the phones that are withdrawn."""
    speech = Speech(epoch=2, sequence=1, media_time=time, active=active)
    return [(void.symbol, void.index) for void in track.add_speech(speech)]


def take(track: PhoneTrack, *phones: Phone) -> list[tuple[str, int, bool]]:
    return [
        (changed.symbol, changed.index, changed.final)
        for phone in phones
        for changed in track.update(phone)
    ]


def test_another_recognizer_continues_the_numbers_and_repeats_nothing() -> None:
    track = PhoneTrack()
    take(track, phone("m", 0, 0), phone("a", 1, 100), phone("n", 2, 200, final=False))
    assert restart(track, 200) == [(SILENCE, 2)]
    repeated, new = phone("a", 4, 110, epoch=2), phone("n", 5, 205, epoch=2)
    assert take(track, repeated, new) == [("n", 8, True)]
    assert track.num_missed == 0


def test_withdraws_a_phone_that_turns_out_to_be_repeated() -> None:
    track = PhoneTrack()
    take(track, phone("a", 0, 100))
    restart(track, 200)
    early = phone("a", 0, 160, epoch=2, final=False)
    assert take(track, early) == [("a", 1, False)]
    assert take(track, phone("a", 0, 110, epoch=2)) == [(SILENCE, 1, True)]


def test_counts_lost_phones_but_no_interrupted_ones() -> None:
    track = PhoneTrack()
    take(track, phone("m", 7, 0), phone("a", 8, 100, final=False))
    assert take(track, phone("n", 9, 400)) == [(SILENCE, 8, True), ("n", 9, True)]
    assert track.num_missed == 0
    take(track, phone("i", 12, 500))
    assert track.num_missed == 2


@pytest.mark.parametrize(
    ("time", "was_speaking", "is_speaking", "num_missed"),
    [
        (1000, True, True, 0),
        (9000, True, False, 1),
        (9000, False, True, 1),
        (9000, False, False, 0),
    ],
)
def test_counts_phones_that_only_the_lost_recognizer_published(
    time: int, was_speaking: bool, is_speaking: bool, num_missed: int
) -> None:
    track = PhoneTrack()
    track.add_speech(Speech(epoch=1, sequence=7, media_time=50, active=was_speaking))
    take(track, phone("m", 0, 900))
    restart(track, time, active=is_speaking)
    assert track.num_missed == num_missed


def test_counts_the_loss_of_the_first_message_of_another_recognizer() -> None:
    track = PhoneTrack()
    take(track, phone("m", 7, 0))
    assert take(track, phone("n", 3, 400, epoch=2)) == [("n", 11, True)]
    assert track.num_missed == 1
