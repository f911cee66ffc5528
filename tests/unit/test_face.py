"""A live face: its mouth, idle motion and amplitude."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import REST_S, FaceAnimator, Frame
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import LIP_HEIGHT_FAPS
from kouxing.services.synthesizer.lips.known_phones import KnownPhones
from kouxing.services.synthesizer.offline import synthesize
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.face.idle_motion import IdleMotion, State
from kouxing.shared.phones.events import EndOfSound, Progress, SpeechChange
from tests.lips import DELAY_S, INVENTORY, LIPS, advance, make_face, phone

pytestmark = pytest.mark.unit

JAW, LOWER_LIP = 2, 4
FRAME_S = 0.02


def values(frames: list[Frame]) -> NDArray[np.float32]:
    return np.array([faps for _, faps in frames])


def speak(face: FaceAnimator, until_s: float = 0.74) -> list[Frame]:
    """Say "da" from 0.3 s on, up to a frame in the middle of the open vowel."""
    frames = advance(face, 0.35)
    face.process(SpeechChange(active=True, time_s=0.3))
    face.process(phone(0, "d", 0.3, 0.1))
    face.process(phone(1, "a", 0.4, 0.6, final=False))
    return frames + advance(face, until_s + DELAY_S)


def test_frames_come_once_each_at_the_frame_rate() -> None:
    face = make_face(delay_s=0.06)
    times = [time_s for time_s, _ in advance(face, 1.0) + advance(face, 1.0) + advance(face, 1.1)]
    np.testing.assert_allclose(times, np.arange(len(times)) * FRAME_S)
    assert times[-1] == pytest.approx(1.04)
    faps = advance(face, 1.2)[0][1]
    assert faps.shape == (68,)
    assert faps.dtype == np.float32


def test_the_face_rests_until_somebody_speaks() -> None:
    assert not values(advance(make_face(), 2.0)).any()


def test_speech_opens_the_mouth_and_its_end_closes_it() -> None:
    face = make_face()
    frames = speak(face)
    assert frames[-1][1][JAW] > 100.0
    face.process(phone(1, "a", 0.4, 0.45))
    face.process(SpeechChange(active=False, time_s=0.85))
    closing = values(advance(face, 1.5))
    assert not closing[-1].round(1).any()


def test_a_phone_whose_end_is_never_heard_fades() -> None:
    face = make_face()
    speak(face)
    assert not advance(face, 10.0)[-1][1].round(1).any()


def test_an_end_of_speech_told_too_early_still_ends_it() -> None:
    face = make_face()
    speak(face)
    face.process(SpeechChange(active=False, time_s=0.35))
    assert not advance(face, 1.2)[-1][1].round(1).any()


def test_flush_returns_to_rest_within_150_ms() -> None:
    face = make_face()
    before = speak(face)[-1][0]
    face.flush()
    face.process(phone(1, "a", 0.4, 0.9))  # a late revision of what was dropped
    after = advance(face, 2.0)
    assert all(not faps.round(3).any() for time_s, faps in after if time_s > before + 0.15)
    assert after[0][1][JAW] > 0.5 * 100.0  # and it does not jump there


def test_flush_works_while_media_time_stands_still() -> None:
    face = make_face()
    speak(face)
    face.flush()
    assert not face.relax(8)[7][1].round(3).any()


def test_flush_then_stall_is_at_rest_in_time_too() -> None:
    face = make_face()
    now_s = speak(face)[-1][0] + DELAY_S
    face.flush()
    advance(face, now_s + 0.041)
    assert not face.relax(7)[6][1].round(3).any()


@pytest.mark.parametrize("delay_s", [0.06, 0.16])
def test_a_long_vowel_stays_open_while_no_news_comes(delay_s: float) -> None:
    face = make_face(delay_s=delay_s)
    face.process(SpeechChange(active=True, time_s=0.3))
    before = advance(face, 0.41)  # a recognizer needs a tenth of a second
    face.process(phone(0, "a", 0.3, 0.15, final=False))
    jaw = values(before + advance(face, 1.6))[:72, JAW]
    assert jaw[21:].min() > 0.4 * jaw.max() > 100.0
    # it hardly falls back on the way, and then holds still
    assert (np.maximum.accumulate(jaw) - jaw).max() < 0.1 * jaw.max()
    assert jaw[35:].min() > 0.95 * jaw.max()


def test_the_mouth_sets_out_before_the_next_phone_is_known() -> None:
    jaws = []
    for duration_s in (0.06, 0.3):
        face = make_face()
        face.process(phone(0, "j", 0.3, duration_s, final=False))
        jaws.append(values(advance(face, 0.4 + DELAY_S))[-1, JAW])
    assert jaws[0] > jaws[1] + 20.0  # a vowel is due after the short one


def test_a_phone_after_a_flush_is_spoken() -> None:
    face = make_face()
    speak(face)
    face.flush()
    advance(face, 1.2)
    face.process(phone(2, "a", 1.2, 0.3))
    assert values(advance(face, 1.5))[-1, JAW] > 100.0


def test_relax_leads_to_rest_and_back_without_a_jump() -> None:
    face = make_face()
    spoken = speak(face)
    rest = face.relax(10) + face.relax(10)
    assert {time_s for time_s, _ in rest} == {spoken[-1][0]}
    assert not rest[-1][1].round(3).any()
    face.process(phone(1, "a", 0.4, 0.9))
    faps = values(spoken[-2:] + rest + advance(face, 1.2))
    assert faps[-1, JAW] > 100.0
    assert np.abs(np.diff(faps[:, JAW])).max() < 200.0


def test_no_jump_when_a_guess_is_replaced() -> None:
    face = make_face()
    speak(face, 0.6)
    face.process(phone(1, "i", 0.4, 0.3))
    face.process(phone(2, "u", 0.6, 0.2, final=False))
    faps = values(advance(face, 0.74 + DELAY_S))
    assert np.abs(np.diff(faps, axis=0)).max() < 300.0


def test_value_and_slope_are_continuous_where_the_trajectory_changes() -> None:
    # at 240 frames a second differences are close to derivatives
    face = make_face(frame_rate_hz=240.0)
    frames = speak(face, 0.43)  # the jaw is moving
    face.process(phone(1, "i", 0.4, 0.2))
    faps = values(frames[-3:] + advance(face, 0.54 + DELAY_S))[:, JAW]
    steps = np.diff(faps)
    assert abs(steps[1]) > 0.5
    # a jump to the new trajectory would be 150, a corner 22
    assert abs(steps[2] - steps[1]) < 5.0


@pytest.mark.parametrize("symbol", INVENTORY.phones)
def test_every_phone_moves_the_face_or_is_silence(symbol: str) -> None:
    face = make_face()
    if symbol in INVENTORY.vowels:
        face.process(phone(0, symbol, 0.3, 0.2))
    else:  # closed lips show between open ones
        face.process(phone(0, "a", 0.1, 0.2))
        face.process(phone(1, symbol, 0.3, 0.2))
        face.process(phone(2, "a", 0.5, 0.2))
    frames = values(advance(face, 1.0))
    faps = frames[20]  # at 0.4 s
    if symbol == "sil":
        assert np.abs(frames[15:25]).max(axis=1).min() < 120.0
    elif symbol in INVENTORY.vowels:
        assert np.abs(faps).max() > 90.0
    else:
        open_mouth = synthesize(LIPS, [phone(0, "a", 0.1, 0.6)], 21)[20]
        assert np.abs(faps - open_mouth).max() > 90.0


@pytest.mark.parametrize("symbol", ["b", "p", "m"])
@pytest.mark.parametrize("late_s", [0.0, 0.03, 0.05])
def test_lips_meet_even_when_recognised_late(symbol: str, late_s: float) -> None:
    face = make_face()
    face.process(phone(0, "a", 0.1, 0.4))
    frames = advance(face, 0.5 + 0.03 + DELAY_S + late_s)  # the frame of the apex has been made
    face.process(phone(1, symbol, 0.5, 0.06))
    face.process(phone(2, "a", 0.56, 0.3))
    faps = values(frames + advance(face, 1.0))[:, np.array(LIP_HEIGHT_FAPS) - 1][25:34]
    assert np.abs(faps[:, :6]).max(axis=1).min() < 12.0


def test_nonsense_is_dropped() -> None:
    known = KnownPhones(INVENTORY)
    assert not known.add_phone(phone(0, "a", math.nan, 0.1))
    assert not known.add_phone(phone(1, "a", 0.1, math.inf))
    assert not known.add_phone(phone(2, "q2", 0.1, 0.1))
    assert not len(known)
    face = make_face()
    face.process(phone(5, "a", 0.3, 0.0))
    face.process(phone(4, "b", 0.29, -1.0))
    face.process(phone(3, "sil", 0.1, 0.0))
    assert np.isfinite(values(advance(face, 1.0))).all()


def test_what_was_flushed_and_estimates_overtaken_are_dropped() -> None:
    known = KnownPhones(INVENTORY)
    assert known.add_phone(phone(0, "a", 0.3, 0.1, final=False))
    assert known.add_phone(phone(0, "a", 0.3, 0.2))
    assert not known.add_phone(phone(0, "a", 0.3, 0.3, final=False))
    known.flush()
    assert not known.add_phone(phone(0, "a", 0.3, 0.4))
    assert known.add_phone(phone(1, "a", 0.6, 0.4))


def test_a_phone_that_is_withdrawn_does_not_move_the_face() -> None:
    face, other = make_face(), make_face()
    for each in (face, other):
        each.process(phone(0, "a", 0.3, 0.2))
    face.process(phone(1, "b", 0.5, 0.1, final=False))
    face.process(phone(1, "sil", 0.5, 0.0))
    np.testing.assert_array_equal(values(advance(face, 1.0)), values(advance(other, 1.0)))


def test_an_overtaken_estimate_is_dropped() -> None:
    face, other = make_face(), make_face()
    for each in (face, other):
        each.process(phone(0, "a", 0.3, 0.2))
    face.process(phone(0, "u", 0.3, 0.3, final=False))
    np.testing.assert_array_equal(values(advance(face, 1.0)), values(advance(other, 1.0)))


def test_another_recognizer_that_tells_the_same_changes_nothing() -> None:
    face, plain = make_face(), make_face()
    frames, expected = speak(face), speak(plain)
    face.change_recognizer()
    face.process(SpeechChange(active=True, time_s=0.3))
    frames += advance(face, 0.6)  # known already
    face.process(phone(0, "a", 0.42, 0.6, final=False))  # was number 1
    for each in (face, plain):
        (frames if each is face else expected).extend(advance(each, 1.2))
    assert [time_s for time_s, _ in frames] == [time_s for time_s, _ in expected]
    np.testing.assert_allclose(values(frames)[:, JAW], values(expected)[:, JAW], atol=30.0)
    face.process(phone(0, "a", 0.42, 0.85))
    face.process(phone(1, "i", 1.27, 0.1))
    assert values(advance(face, 1.5))[:, JAW].max() > 100.0


def test_a_phone_that_another_recognizer_does_not_confirm_is_withdrawn() -> None:
    face, plain = make_face(), make_face()
    for each in (face, plain):
        speak(each)
    face.change_recognizer()
    face.process(phone(0, "i", 0.4, 0.8))
    plain.process(phone(1, "i", 0.4, 0.8))
    after, revised = (values(advance(each, 1.0)) for each in (face, plain))
    np.testing.assert_allclose(after, revised, atol=1.0)


def test_a_face_takes_the_place_of_another() -> None:
    first, second, plain = (make_face(idle_motion_seed=5) for _ in range(3))
    expected = speak(plain) + plain.relax(3) + advance(plain, 1.4)
    shown = speak(first) + first.relax(3)
    second.resume(shown[-1][0], len(shown), shown[-1][1])
    assert speak(second) == []
    frames = shown + advance(second, 1.4)
    assert [time_s for time_s, _ in frames] == [time_s for time_s, _ in expected]
    step, usual = (np.abs(np.diff(values(each), axis=0)).max(axis=0) for each in (frames, expected))
    assert (step <= 1.2 * usual).all()


def test_a_face_that_knows_nothing_of_the_one_before_begins_behind_it() -> None:
    face = make_face(idle_motion_seed=5)
    face.resume(20.0, 1000)
    frames = advance(face, 20.1 + DELAY_S)
    assert frames[0][0] == pytest.approx(20.02)
    plain = advance(make_face(idle_motion_seed=5), 9.0)[-1]
    assert np.abs(frames[0][1] - plain[1]).max() > 0.0


def test_a_long_gap_is_not_filled_with_frames() -> None:
    face = make_face()
    last_s = speak(face)[-1][0]
    frames = advance(face, last_s + DELAY_S + 60.0)
    assert [time_s for time_s, _ in frames] == [pytest.approx(last_s + 60.0)]
    assert not values(frames).any()


def test_the_end_of_the_sound_brings_the_frames_owed_and_leads_to_rest() -> None:
    face = make_face()
    frames = speak(face)
    frames += face.process(EndOfSound(time_s=0.95))
    np.testing.assert_allclose([time_s for time_s, _ in frames], np.arange(len(frames)) * FRAME_S)
    assert frames[-1][0] == pytest.approx(0.95 + REST_S, abs=FRAME_S)
    assert not frames[-1][1].round(1).any()


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(UserError, match="delay_s"):
        make_face(delay_s=1.6)
    with pytest.raises(UserError, match="frame_rate_hz"):
        make_face(frame_rate_hz=5.0)


def test_a_longer_delay_comes_nearer_to_the_full_model() -> None:
    spoken = [
        phone(i, symbol, 0.3 + 0.1 * i, 0.1)
        for i, symbol in enumerate("n i h ao b iao j u d an sh uo".split())
    ]
    whole = synthesize(LIPS, spoken, 90)
    errors = []
    for delay_s in (0.0, 0.1, 0.3):
        face = make_face(delay_s=delay_s)
        frames = []
        for each in spoken:
            frames += advance(face, each.onset_s + 0.05)
            face.process(each)
        face.process(SpeechChange(active=False, time_s=1.5))
        frames += advance(face, 2.2)
        errors.append(float(np.sqrt(np.mean((values(frames)[:90] - whole) ** 2))))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.1 * errors[0]


def test_loud_speech_opens_the_mouth_further_but_never_a_closure() -> None:
    spoken = [phone(0, "a", 0.0, 0.5), phone(1, "b", 0.5, 0.1), phone(2, "a", 0.6, 0.5)]
    faps = []
    for level_db in (-36.0, -26.0, -16.0):
        face = make_face()
        for each in spoken:
            face.process(each)
        frames = []
        for step in range(140):
            frames += face.process(Progress(time_s=step * 0.01, level_db=level_db))
        faps.append(values(frames))
    jaws = [each[18:24, JAW].mean() for each in faps]
    assert jaws[0] < 0.95 * jaws[1] < 0.9 * jaws[2]
    inner = np.array([4, 5, 8, 9, 10, 11]) - 1
    assert all(np.abs(each[26:29, inner]).max(axis=1).min() < 5.0 for each in faps)


def test_idle_motion_follows_from_the_seed_and_leave_the_mouth_alone() -> None:
    with_motion = [make_face(idle_motion_seed=seed) for seed in (1, 1, 2)]
    one, same, other = (values(speak(face)) for face in with_motion)
    plain = values(speak(make_face()))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 100.0
    mouth = np.array(MOUTH_FAPS) - 1
    np.testing.assert_array_equal(one[:, mouth], plain[:, mouth])


def test_idle_motion_has_natural_figures() -> None:
    motion, minutes, rate_hz = IdleMotion(7), 10, 50
    faps = np.zeros((minutes * 60 * rate_hz, 68), dtype=np.float32)
    for k, row in enumerate(faps):
        motion.apply(row, k / rate_hz, State.SPEAKING)
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
    face = make_face(idle_motion_seed=3)
    advance(face, 0.2)
    assert values(face.relax(600))[:, 18].max() > 500.0  # a blink
