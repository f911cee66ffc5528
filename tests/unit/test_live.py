"""The live synthesizer, its gestures and its loudness."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.synthesizer.full import synthesize
from services.synthesizer.gesture import Gesture
from services.synthesizer.live import FapFrame, LiveSynthesizer
from services.synthesizer.parameters import load_parameters
from services.synthesizer.visemes import LIP_HEIGHT_FAPS, MOUTH_FAPS
from shared.errors import UserError
from shared.phones import FINALS, UNITS, Phone, SpeechChange

pytestmark = pytest.mark.unit

PARAMETERS = load_parameters()
JAW, LOWER_LIP = 2, 4
FRAME_S = 0.02


def phone(index: int, unit: str, onset_s: float, duration_s: float, final: bool = True) -> Phone:
    return Phone(
        index=index,
        unit=unit,
        onset_s=onset_s,
        duration_s=duration_s,
        confidence=1.0,
        final=final,
    )


def values(frames: list[FapFrame]) -> NDArray[np.float32]:
    return np.array([faps for _, faps in frames])


def speak(live: LiveSynthesizer, until_s: float = 0.8) -> list[FapFrame]:
    """Say "da" from 0.3 s on and stop in the middle of the open vowel."""
    frames = live.advance(0.35)
    live.accept_speech(SpeechChange(active=True, time_s=0.3))
    live.accept_phone(phone(0, "d", 0.3, 0.1))
    live.accept_phone(phone(1, "a", 0.4, 0.6, final=False))
    return frames + live.advance(until_s)


def test_frames_come_once_each_at_the_frame_rate() -> None:
    live = LiveSynthesizer(PARAMETERS, look_ahead_s=0.06)
    times = [time_s for time_s, _ in live.advance(1.0) + live.advance(1.0) + live.advance(1.1)]
    np.testing.assert_allclose(times, np.arange(len(times)) * FRAME_S)
    assert times[-1] == pytest.approx(1.04)
    faps = live.advance(1.2)[0][1]
    assert faps.shape == (68,)
    assert faps.dtype == np.float32


def test_the_face_rests_until_somebody_speaks() -> None:
    assert not values(LiveSynthesizer(PARAMETERS).advance(2.0)).any()


def test_speech_opens_the_mouth_and_its_end_closes_it() -> None:
    live = LiveSynthesizer(PARAMETERS)
    frames = speak(live)
    assert frames[-1][1][JAW] > 100.0
    live.accept_phone(phone(1, "a", 0.4, 0.45))
    live.accept_speech(SpeechChange(active=False, time_s=0.85))
    closing = values(live.advance(1.5))
    assert not closing[-1].round(1).any()


def test_a_unit_whose_end_is_never_heard_fades() -> None:
    live = LiveSynthesizer(PARAMETERS)
    speak(live)
    assert not live.advance(60.0)[-1][1].round(1).any()


def test_an_end_of_speech_told_too_early_still_ends_it() -> None:
    live = LiveSynthesizer(PARAMETERS)
    speak(live)
    live.accept_speech(SpeechChange(active=False, time_s=0.35))
    assert not live.advance(1.2)[-1][1].round(1).any()


def test_flush_returns_to_rest_within_150_ms() -> None:
    live = LiveSynthesizer(PARAMETERS)
    before = speak(live)[-1][0]
    live.flush()
    live.accept_phone(phone(1, "a", 0.4, 0.9))  # a late revision of what was dropped
    assert live.num_ignored == 1
    after = live.advance(2.0)
    assert all(not faps.round(3).any() for time_s, faps in after if time_s > before + 0.15)
    assert after[0][1][JAW] > 0.5 * 100.0  # and it does not jump there


def test_flush_works_while_media_time_stands_still() -> None:
    live = LiveSynthesizer(PARAMETERS)
    speak(live)
    live.flush()
    assert not live.relax(8)[7][1].round(3).any()


def test_flush_then_stall_is_at_rest_in_time_too() -> None:
    live = LiveSynthesizer(PARAMETERS)
    now_s = speak(live)[-1][0] + 0.06
    live.flush()
    live.advance(now_s + 0.041)
    assert not live.relax(7)[6][1].round(3).any()


def test_a_long_vowel_stays_open_while_no_news_comes() -> None:
    live = LiveSynthesizer(PARAMETERS, look_ahead_s=0.16)
    live.accept_speech(SpeechChange(active=True, time_s=0.3))
    before = live.advance(0.41)  # a recognizer needs a tenth of a second
    live.accept_phone(phone(0, "a", 0.3, 0.15, final=False))
    jaw = values(before + live.advance(1.6))[:72, JAW]
    assert jaw[21:].min() > 0.4 * jaw.max() > 100.0
    # it hardly falls back on the way, and then holds still
    assert (np.maximum.accumulate(jaw) - jaw).max() < 0.1 * jaw.max()
    assert jaw[35:].min() > 0.95 * jaw.max()


def test_the_mouth_sets_out_before_the_next_unit_is_known() -> None:
    jaws = []
    for duration_s in (0.06, 0.3):
        live = LiveSynthesizer(PARAMETERS)
        live.accept_phone(phone(0, "j", 0.3, duration_s, final=False))
        jaws.append(values(live.advance(0.46))[-1, JAW])
    assert jaws[0] > jaws[1] + 20.0  # a final is due after the short one


def test_a_unit_after_a_flush_is_spoken() -> None:
    live = LiveSynthesizer(PARAMETERS)
    speak(live)
    live.flush()
    live.advance(1.2)
    live.accept_phone(phone(2, "a", 1.2, 0.3))
    assert values(live.advance(1.5))[-1, JAW] > 100.0


def test_relax_leads_to_rest_and_back_without_a_jump() -> None:
    live = LiveSynthesizer(PARAMETERS)
    said = speak(live)
    rest = live.relax(10) + live.relax(10)
    assert {time_s for time_s, _ in rest} == {said[-1][0]}
    assert not rest[-1][1].round(3).any()
    live.accept_phone(phone(1, "a", 0.4, 0.9))
    faps = values(said[-2:] + rest + live.advance(1.2))
    assert faps[-1, JAW] > 100.0
    assert np.abs(np.diff(faps[:, JAW])).max() < 200.0


def test_no_jump_when_a_guess_is_replaced() -> None:
    live = LiveSynthesizer(PARAMETERS)
    speak(live, 0.66)
    live.accept_phone(phone(1, "i", 0.4, 0.3))
    live.accept_phone(phone(2, "u", 0.6, 0.2, final=False))
    faps = values(live.advance(0.8))
    assert np.abs(np.diff(faps, axis=0)).max() < 300.0


def test_value_and_slope_are_continuous_where_the_plan_changes() -> None:
    # at 240 frames a second differences are close to derivatives
    live = LiveSynthesizer(PARAMETERS, frame_rate_hz=240.0)
    frames = speak(live, 0.49)  # the jaw is moving
    live.accept_phone(phone(1, "i", 0.4, 0.2))
    faps = values(frames[-3:] + live.advance(0.6))[:, JAW]
    steps = np.diff(faps)
    assert abs(steps[1]) > 0.5
    # a jump to the new plan would be fifty times as large, a corner ten times
    assert abs(steps[2] - steps[1]) < 5.0


@pytest.mark.parametrize("unit", UNITS)
def test_every_unit_moves_the_face_or_is_silence(unit: str) -> None:
    live = LiveSynthesizer(PARAMETERS)
    if unit in FINALS:
        live.accept_phone(phone(0, unit, 0.3, 0.2))
    else:  # closed lips show between open ones
        live.accept_phone(phone(0, "a", 0.1, 0.2))
        live.accept_phone(phone(1, unit, 0.3, 0.2))
        live.accept_phone(phone(2, "a", 0.5, 0.2))
    faps = values(live.advance(1.0))[20]  # at 0.4 s
    if unit == "sil":
        assert np.abs(faps).max() < 120.0
    elif unit in FINALS:
        assert np.abs(faps).max() > 90.0
    else:
        open_mouth = synthesize(PARAMETERS, [phone(0, "a", 0.1, 0.6)], 21)[20]
        assert np.abs(faps - open_mouth).max() > 90.0


@pytest.mark.parametrize("unit", ["b", "p", "m"])
@pytest.mark.parametrize("late_s", [0.0, 0.03, 0.05])
def test_lips_meet_even_when_recognised_late(unit: str, late_s: float) -> None:
    live = LiveSynthesizer(PARAMETERS)
    live.accept_phone(phone(0, "a", 0.1, 0.4))
    frames = live.advance(0.5 + 0.03 + 0.06 + late_s)  # the centre has been put out
    live.accept_phone(phone(1, unit, 0.5, 0.06))
    live.accept_phone(phone(2, "a", 0.56, 0.3))
    faps = values(frames + live.advance(1.0))[:, np.array(LIP_HEIGHT_FAPS) - 1][25:34]
    assert np.abs(faps[:, :6]).max(axis=1).min() < 12.0


def test_nonsense_is_counted_and_dropped() -> None:
    live = LiveSynthesizer(PARAMETERS)
    live.accept_phone(phone(0, "a", math.nan, 0.1))
    live.accept_phone(phone(1, "a", 0.1, math.inf))
    live.accept_phone(phone(2, "q2", 0.1, 0.1))
    assert live.num_ignored == 3
    live.accept_phone(phone(5, "a", 0.3, 0.0))
    live.accept_phone(phone(4, "b", 0.29, -1.0))
    live.accept_phone(phone(3, "sil", 0.1, 0.0))
    assert np.isfinite(values(live.advance(1.0))).all()


def test_an_overtaken_estimate_is_dropped() -> None:
    live, other = LiveSynthesizer(PARAMETERS), LiveSynthesizer(PARAMETERS)
    for each in (live, other):
        each.accept_phone(phone(0, "a", 0.3, 0.2))
    live.accept_phone(phone(0, "u", 0.3, 0.3, final=False))
    np.testing.assert_array_equal(values(live.advance(1.0)), values(other.advance(1.0)))


def test_reset_begins_anew_anywhere() -> None:
    live = LiveSynthesizer(PARAMETERS)
    first = values(speak(live))
    live.reset()
    np.testing.assert_array_equal(values(speak(live)), first)
    live.reset(1e6)
    live.accept_phone(phone(0, "a", 1e6, 0.2))
    frames = live.advance(1e6 + 0.3)
    assert frames[0][0] == 1e6
    assert len(frames) == 13
    assert values(frames)[:, JAW].max() > 100.0


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(UserError, match="look_ahead_s"):
        LiveSynthesizer(PARAMETERS, look_ahead_s=0.4)
    with pytest.raises(UserError, match="frame_rate_hz"):
        LiveSynthesizer(PARAMETERS, frame_rate_hz=5.0)


def test_more_look_ahead_comes_nearer_to_the_full_model() -> None:
    spoken = [
        phone(i, unit, 0.3 + 0.1 * i, 0.1)
        for i, unit in enumerate("n i h ao b iao j u d an sh uo".split())
    ]
    whole = synthesize(PARAMETERS, spoken, 90)
    errors = []
    for look_ahead_s in (0.0, 0.1, 0.3):
        live = LiveSynthesizer(PARAMETERS, look_ahead_s=look_ahead_s)
        frames = []
        for each in spoken:
            frames += live.advance(each.onset_s + 0.05)
            live.accept_phone(each)
        live.accept_speech(SpeechChange(active=False, time_s=1.5))
        frames += live.advance(2.2)
        errors.append(float(np.sqrt(np.mean((values(frames)[:90] - whole) ** 2))))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.1 * errors[0]


def test_loud_speech_opens_the_mouth_further_but_never_a_closure() -> None:
    spoken = [phone(0, "a", 0.0, 0.5), phone(1, "b", 0.5, 0.1), phone(2, "a", 0.6, 0.5)]
    faps = []
    for level_db in (-36.0, -26.0, -16.0):
        live = LiveSynthesizer(PARAMETERS)
        for each in spoken:
            live.accept_phone(each)
        for step in range(120):
            live.accept_level(step * 0.01, level_db)
        faps.append(values(live.advance(1.2)))
    jaws = [each[18:24, JAW].mean() for each in faps]
    assert jaws[0] < 0.95 * jaws[1] < 0.9 * jaws[2]
    inner = np.array([4, 5, 8, 9, 10, 11]) - 1
    assert all(np.abs(each[26:29, inner]).max(axis=1).min() < 5.0 for each in faps)


def test_gestures_follow_from_the_seed_and_leave_the_mouth_alone() -> None:
    with_gestures = [LiveSynthesizer(PARAMETERS, gesture_seed=seed) for seed in (1, 1, 2)]
    one, same, other = (values(speak(live)) for live in with_gestures)
    plain = values(speak(LiveSynthesizer(PARAMETERS)))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 100.0
    mouth = np.array(MOUTH_FAPS) - 1
    np.testing.assert_array_equal(one[:, mouth], plain[:, mouth])


def test_gestures_have_natural_figures() -> None:
    gesture, minutes, rate_hz = Gesture(7), 10, 50
    faps = np.zeros((minutes * 60 * rate_hz, 68), dtype=np.float32)
    for k, row in enumerate(faps):
        gesture.add_to(row, k / rate_hz, speaking=True)
    shut = faps[:, 18] > 500.0
    assert 12 < np.count_nonzero(shut[1:] & ~shut[:-1]) / minutes < 24  # blinks a minute
    np.testing.assert_array_equal(faps[:, 18], faps[:, 19])
    head_deg = np.rad2deg(faps[:, 47:50] * 1e-5)
    assert (head_deg.std(axis=0) > 0.4).all()
    assert np.abs(head_deg).max() < 6.0
    assert np.abs(np.diff(head_deg, axis=0)).max() * rate_hz < 20.0  # degrees a second
    gaze_deg = np.rad2deg((faps[:, 22] + faps[:, 48]) * 1e-5)  # in space: eye and head
    assert np.median(np.abs(gaze_deg)) < 1.0
    assert 4.0 < np.abs(gaze_deg).max() <= 12.1


def test_eyes_go_on_while_media_time_stands_still() -> None:
    live = LiveSynthesizer(PARAMETERS, gesture_seed=3)
    live.advance(0.2)
    assert values(live.relax(600))[:, 18].max() > 500.0  # a blink
