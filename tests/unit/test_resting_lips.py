"""Lips rest as on film: ajar in pauses, closed in silence, and parted before a sound."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.learned.resting_lips import (
    CERTAIN,
    CLOSE_S,
    HOLD_S,
    LEAD_S,
    PART_S,
    RestingLips,
)
from kouxing.shared.phones.events import EndOfSound, Progress, SpeechChange

FRAME_S = 0.02
LOUD_DB, QUIET_DB = -20.0, -60.0
SOUND_S = 1.0  # when the sound ends


def ajar_amounts(
    level_at: Callable[[float], float],
    until_s: float,
    delay_s: float = 0.06,
    voice: tuple[float, ...] = (0.0,),
    closure: float = 0.1,
    phone_s: float = math.inf,
) -> NDArray[np.float64]:
    """Return how far the mouth is ajar at each frame; ``voice``: times at which it changes."""
    lips = RestingLips()
    for number, time_s in enumerate(voice):
        lips.add_event(SpeechChange(active=number % 2 == 0, time_s=time_s))
    delay = round(delay_s / FRAME_S)
    amounts = []
    for number in range(round(until_s / FRAME_S) + delay):
        time_s = number * FRAME_S
        lips.add_event(Progress(time_s=time_s, level_db=level_at(time_s)))
        if number >= delay:
            frame_s = (number - delay) * FRAME_S
            lips.process_until(frame_s)
            is_phone = phone_s <= frame_s < phone_s + 0.1
            lips.silence_penalty_at(frame_s, closure if frame_s > SOUND_S else 0.1, 2.0 * is_phone)
            amounts.append(lips.amount_at(frame_s))
    return np.array(amounts)


def sound_until_pause(time_s: float) -> float:
    return LOUD_DB if time_s <= SOUND_S else QUIET_DB


def at(amounts: NDArray[np.float64], time_s: float) -> float:
    return float(amounts[round(time_s / FRAME_S)])


@pytest.mark.parametrize("delay_s", [0.06, 0.3])
def test_lips_part_in_a_pause_hold_and_close_slowly(delay_s: float) -> None:
    amounts = ajar_amounts(sound_until_pause, 3.0, delay_s)
    assert not amounts[: round(SOUND_S / FRAME_S)].any()
    assert at(amounts, SOUND_S + 0.24) == 1.0
    assert at(amounts, SOUND_S + 0.8) == 1.0
    closing_s = 1e-9 + FRAME_S * np.count_nonzero(
        (amounts > 0.0) & (np.diff(amounts, append=0.0) < 0.0)
    )
    assert 0.3 <= closing_s <= 0.45
    assert not amounts[round((SOUND_S + 1.3) / FRAME_S) :].any()
    assert np.abs(np.diff(amounts)).max() < 0.25  # no jump


def test_the_closure_of_a_stop_does_not_count_as_a_pause() -> None:
    amounts = ajar_amounts(lambda time_s: QUIET_DB if 1.0 < time_s <= 1.1 else LOUD_DB, 2.0)
    assert not amounts.any()


def test_lips_follow_the_predictor_again_before_the_next_sound() -> None:
    amounts = ajar_amounts(lambda time_s: QUIET_DB if 1.0 < time_s <= 1.5 else LOUD_DB, 2.0)
    assert at(amounts, 1.4) == 1.0
    assert at(amounts, 1.52) < 0.01
    assert not amounts[round(1.54 / FRAME_S) :].any()


def test_lips_that_the_predictor_closes_in_a_pause_stay_closed() -> None:
    assert not ajar_amounts(sound_until_pause, 3.0, closure=CERTAIN).any()


def test_a_closing_phone_closes_the_lips_in_a_pause() -> None:
    amounts = ajar_amounts(sound_until_pause, 3.0, phone_s=1.5)
    assert at(amounts, 1.48) == 1.0
    assert at(amounts, 1.58) == 0.0
    assert at(amounts, 1.8) == 1.0


def test_lips_part_before_a_sound_as_early_as_it_is_known() -> None:
    amounts = ajar_amounts(lambda t: LOUD_DB if t > 2.3 else QUIET_DB, 2.3, 0.3, voice=(2.1,))
    assert at(amounts, 2.1 - LEAD_S - FRAME_S) == 0.0
    assert at(amounts, 2.1 - LEAD_S + PART_S + 0.02) == 1.0
    assert at(amounts, 2.2) == 1.0


@pytest.mark.parametrize("level_db", [QUIET_DB, LOUD_DB])
def test_without_voice_lips_part_at_the_start_and_then_stay_closed(level_db: float) -> None:
    amounts = ajar_amounts(lambda _: level_db, 2.0, voice=())
    assert at(amounts, 0.0) < 0.1
    assert at(amounts, PART_S + FRAME_S) == 1.0
    assert at(amounts, HOLD_S - FRAME_S) == 1.0
    assert not amounts[round((HOLD_S + CLOSE_S + 2 * FRAME_S) / FRAME_S) :].any()


@pytest.mark.parametrize("rise_db", [7.0, 9.0])
def test_an_onset_before_voice_activity_closes_the_lips(rise_db: float) -> None:
    amounts = ajar_amounts(lambda t: -40.0 + rise_db * (t >= 0.6), 0.8, voice=())
    assert at(amounts, 0.52) == 1.0
    assert (at(amounts, 0.6) == 0.0) == (rise_db == 9.0)


def test_a_low_first_level_does_not_make_the_next_levels_an_onset() -> None:
    amounts = ajar_amounts(lambda t: -40.0 if t >= FRAME_S else -60.0, 0.6, voice=())
    assert at(amounts, PART_S + FRAME_S) == 1.0
    assert amounts[round(PART_S / FRAME_S) + 1 :].all()


def test_an_onset_after_voice_activity_does_not_close_the_lips() -> None:
    def level_at(time_s: float) -> float:
        return LOUD_DB if time_s <= SOUND_S or time_s >= 1.5 else QUIET_DB

    amounts = ajar_amounts(level_at, 1.8, voice=(0.0, 1.2))
    assert at(amounts, 1.5) == 1.0
    assert at(amounts, 1.6) == 1.0


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.04, 0.06])
def test_the_lips_move_in_speech_with_any_delay(delay_s: float) -> None:
    amounts = ajar_amounts(lambda _: LOUD_DB, 1.0, delay_s=delay_s, voice=(0.2,))
    assert at(amounts, 0.1) > 0.5
    assert not amounts[round(0.4 / FRAME_S) :].any()


def test_a_bang_does_not_freeze_the_mouth() -> None:
    amounts = ajar_amounts(lambda time_s: 0.0 if 0.5 < time_s <= 0.6 else -30.0, 3.0)
    assert not amounts[round(1.5 / FRAME_S) :].any()


def test_a_later_loud_sound_does_not_turn_quiet_speech_into_a_pause() -> None:
    amounts = ajar_amounts(lambda time_s: -40.0 if time_s < 1.4 else -12.0, 1.0, delay_s=1.5)
    assert not amounts[round(0.5 / FRAME_S) :].any()


def test_the_end_of_the_sound_closes_the_lips_in_300_ms() -> None:
    lips = RestingLips()
    lips.add_event(SpeechChange(active=True, time_s=0.0))
    for number in range(80):
        lips.add_event(
            Progress(time_s=number * FRAME_S, level_db=sound_until_pause(number * FRAME_S))
        )
    amounts = []
    for number in range(94):
        if number == 79:
            lips.add_event(EndOfSound(time_s=number * FRAME_S))
        lips.process_until(number * FRAME_S)
        amounts.append(lips.amount_at(number * FRAME_S))
    assert amounts[78] == 1.0
    assert amounts[-1] == 0.0
