"""Each phone of a session counts once, whichever recognizers publish it."""

from __future__ import annotations

from kouxing_client import Phone
from kouxing_client.messages import SILENCE
from kouxing_client.phone_track import PhoneTrack


def phone(
    symbol: str, index: int, onset: int, *, epoch: int = 1, final: bool = True, duration: int = 100
) -> Phone:
    return Phone(
        symbol=symbol,
        index=index,
        media_time=onset,
        epoch=epoch,
        duration=duration,
        confidence=1.0,
        final=final,
    )


def take(track: PhoneTrack, *phones: Phone) -> list[tuple[str, int, bool]]:
    return [
        (changed.symbol, changed.index, changed.final)
        for one in phones
        for changed in track.update(one)
    ]


def test_another_recognizer_continues_the_numbers_and_repeats_nothing() -> None:
    track = PhoneTrack()
    take(track, phone("m", 0, 0), phone("a", 1, 100), phone("n", 2, 200, final=False))
    assert [(void.symbol, void.index) for void in track.restart()] == [(SILENCE, 2)]
    repeated, new = phone("a", 4, 110, epoch=2), phone("n", 5, 205, epoch=2)
    assert take(track, repeated, new) == [("n", 8, True)]
    assert track.num_missed == 0


def test_withdraws_a_phone_that_turns_out_to_be_repeated() -> None:
    track = PhoneTrack()
    take(track, phone("a", 0, 100))
    track.restart()
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


def test_counts_the_loss_of_the_first_message_of_another_recognizer() -> None:
    track = PhoneTrack()
    take(track, phone("m", 7, 0))
    assert take(track, phone("n", 3, 400, epoch=2)) == [("n", 11, True)]
    assert track.num_missed == 1
