"""The figures of a fault, for artificial frames and phones."""

from __future__ import annotations

from array import array

import pytest
from kouxing_client import FapFrame, Phone, Speech

from kouxing.evaluation.system.continuity import compare
from kouxing.evaluation.system.live import Seen

JAW = 2  # index of FAP 3


def frame(number: int, *, epoch: int = 1, jaw: float | None = None) -> FapFrame:
    values = array("f", bytes(4 * 68))
    values[JAW] = 10.0 * number if jaw is None else jaw
    return FapFrame(session="s", epoch=epoch, media_time=320 * number, values=values)


def phone(index: int, symbol: str, *, epoch: int = 1, final: bool = True, at: int = -1) -> Phone:
    return Phone(
        session="s",
        epoch=epoch,
        media_time=1600 * (index if at < 0 else at),
        index=index,
        symbol=symbol,
        duration=1600,
        confidence=1.0,
        final=final,
    )


def seen(*frames: tuple[float, FapFrame], phones: tuple[Phone, ...] = ()) -> Seen:
    return Seen(frames=list(frames), phones=list(phones), ended=True, live_until_s=1.0)


def in_time(*numbers: int, epoch: int = 1) -> list[tuple[float, FapFrame]]:
    return [(0.06 + number / 50, frame(number, epoch=epoch)) for number in numbers]


UNDISTURBED = seen(
    *in_time(*range(47)), phones=(phone(0, "n"), phone(1, "i"), phone(2, "sil"), phone(3, "h"))
)


def test_a_session_without_a_fault_loses_nothing() -> None:
    face = compare(UNDISTURBED, UNDISTURBED, "sil", 0.06, fault_s=0.2)
    assert (face.phones, face.phones_lost, face.phones_doubled, face.phones_changed) == (3, 0, 0, 0)
    assert (face.frames_lost, face.frames_doubled, face.rest_frames) == (0, 0, 0)
    assert (face.largest_step, face.largest_step_fap) == (1.0, "open_jaw")
    assert face.stood_s == pytest.approx(0.06)
    assert face.late_p95_ms == pytest.approx(0.0, abs=1e-6)


def test_distinguishes_lost_and_repeated_frames_from_rest() -> None:
    broken = seen(
        *in_time(*range(10)),
        (0.30, frame(9)),  # at rest
        (0.32, frame(9)),
        (0.50, frame(8, epoch=2, jaw=90.0)),
        (0.50, frame(9, epoch=2)),  # doubled, too
        *in_time(*range(25, 47), epoch=2),
    )
    face = compare(broken, UNDISTURBED, "sil", 0.06, fault_s=0.2)
    assert face.rest_frames == 2
    assert face.frames_doubled == 2
    assert face.frames_lost == 15
    assert face.stood_s == pytest.approx(25 / 50 - 9 / 50)
    assert face.largest_step == pytest.approx(16.0)  # from 9 to 25


def test_joins_the_phones_of_two_epochs() -> None:
    broken = seen(
        *in_time(*range(47)),
        phones=(
            phone(0, "n"),
            phone(1, "i", final=False),  # void: its epoch ended
            phone(0, "i", epoch=2, at=1),
            phone(1, "i", epoch=2, at=2),  # doubled
            phone(2, "sil", epoch=2, at=3),
        ),
    )
    face = compare(broken, UNDISTURBED, "sil", 0.06, fault_s=0.2)
    assert (face.phones_lost, face.phones_doubled, face.phones_changed) == (0, 0, 1)  # h became i
    revised = seen(
        *in_time(1, 2), phones=(phone(0, "m", final=False), phone(0, "n"), phone(1, "i"))
    )
    assert compare(revised, UNDISTURBED, "sil", 0.06, fault_s=0.2).phones_lost == 1


def test_counts_phones_repeated_by_a_new_recognizer_once() -> None:
    broken = seen(
        *in_time(*range(47)),
        phones=(
            phone(0, "n"),
            phone(1, "i"),  # void: its middle does not lie before
            phone(5, "i", epoch=2, at=1),
            phone(6, "h", epoch=2, at=3),
        ),
    )
    broken.speech.append(Speech(session="s", epoch=2, sequence=1, media_time=1600, active=True))
    face = compare(broken, UNDISTURBED, "sil", 0.06, fault_s=0.2)
    assert (face.phones_lost, face.phones_doubled, face.phones_changed) == (0, 0, 0)
