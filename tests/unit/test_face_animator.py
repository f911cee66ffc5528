"""A live face: its mouth, idle motion and amplitude."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.evaluation.lips.full_model import synthesize
from kouxing.services.synthesizer.face_animator import REST_S, FaceAnimator, Frame
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import LIP_HEIGHT_FAPS
from kouxing.services.synthesizer.lips.known_phones import KnownPhones
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.face.idle_motion import IdleMotion, State
from kouxing.shared.phones.events import EndOfSound, SpeechChange
from tests.lips import DELAY_S, INVENTORY, LIPS, advance, make_face, phone

pytestmark = pytest.mark.unit

JAW, LOWER_LIP = 2, 4
FRAME_S = 0.02


def values(frames: list[Frame]) -> NDArray[np.float32]:
    return np.array([faps for _, faps in frames])


def speak(face: FaceAnimator, until_s: float = 0.74) -> list[Frame]:
    """Process "da" from 0.3 s, up to the middle of the open vowel."""
    frames = advance(face, 0.35)
    face.process(SpeechChange(active=True, time_s=0.3))
    face.process(phone(0, "d", 0.3, 0.1))
    face.process(phone(1, "a", 0.4, 0.6, final=False))
    return frames + advance(face, until_s + DELAY_S)


def test_frames_have_the_frame_rate() -> None:
    face = make_face(delay_s=0.06)
    times = [time_s for time_s, _ in advance(face, 1.0) + advance(face, 1.0) + advance(face, 1.1)]
    np.testing.assert_allclose(times, np.arange(len(times)) * FRAME_S)
    assert times[-1] == pytest.approx(1.04)
    faps = advance(face, 1.2)[0][1]
    assert faps.shape == (68,)
    assert faps.dtype == np.float32


def test_speech_opens_and_closes_the_mouth() -> None:
    face = make_face()
    frames = speak(face)
    assert frames[-1][1][JAW] > 100.0
    face.process(phone(1, "a", 0.4, 0.45))
    face.process(SpeechChange(active=False, time_s=0.85))
    closing = values(advance(face, 1.5))
    assert not closing[-1].round(1).any()


def test_a_phone_without_an_end_fades() -> None:
    face = make_face()
    speak(face)
    assert not advance(face, 10.0)[-1][1].round(1).any()


def test_an_early_end_of_speech_still_ends_it() -> None:
    face = make_face()
    speak(face)
    face.process(SpeechChange(active=False, time_s=0.35))
    assert not advance(face, 1.2)[-1][1].round(1).any()


def test_flush_then_stall_rests_in_time() -> None:
    face = make_face()
    now_s = speak(face)[-1][0] + DELAY_S
    face.flush()
    advance(face, now_s + 0.041)
    assert not face.relax(7)[6][1].round(3).any()


@pytest.mark.parametrize("delay_s", [0.06, 0.16])
def test_a_long_vowel_stays_open_without_new_phones(delay_s: float) -> None:
    face = make_face(delay_s=delay_s)
    face.process(SpeechChange(active=True, time_s=0.3))
    before = advance(face, 0.41)  # recognition takes 0.1 s
    face.process(phone(0, "a", 0.3, 0.15, final=False))
    jaw = values(before + advance(face, 1.6))[:72, JAW]
    assert jaw[21:].min() > 0.4 * jaw.max() > 100.0
    # it rises without falling back, then stays
    assert (np.maximum.accumulate(jaw) - jaw).max() < 0.1 * jaw.max()
    assert jaw[35:].min() > 0.95 * jaw.max()


def test_mouth_moves_before_the_next_phone_is_known() -> None:
    jaws = []
    for duration_s in (0.06, 0.3):
        face = make_face()
        face.process(phone(0, "j", 0.3, duration_s, final=False))
        jaws.append(values(advance(face, 0.4 + DELAY_S))[-1, JAW])
    assert jaws[0] > jaws[1] + 20.0  # a vowel is expected


def test_a_phone_after_a_flush_moves_the_mouth() -> None:
    face = make_face()
    speak(face)
    face.flush()
    advance(face, 1.2)
    face.process(phone(2, "a", 1.2, 0.3))
    assert values(advance(face, 1.5))[-1, JAW] > 100.0


def test_relaxes_and_returns_without_a_jump() -> None:
    face = make_face()
    spoken = speak(face)
    rest = face.relax(10) + face.relax(10)
    assert {time_s for time_s, _ in rest} == {spoken[-1][0]}
    assert not rest[-1][1].round(3).any()
    face.process(phone(1, "a", 0.4, 0.9))
    faps = values(spoken[-2:] + rest + advance(face, 1.2))
    assert faps[-1, JAW] > 100.0
    assert np.abs(np.diff(faps[:, JAW])).max() < 200.0


@pytest.mark.parametrize("symbol", ["b", "p", "m"])
@pytest.mark.parametrize("late_s", [0.0, 0.03, 0.05])
def test_late_closures_are_shown(symbol: str, late_s: float) -> None:
    face = make_face()
    face.process(phone(0, "a", 0.1, 0.4))
    frames = advance(face, 0.5 + 0.03 + DELAY_S + late_s)  # after the frame of the apex
    face.process(phone(1, symbol, 0.5, 0.06))
    face.process(phone(2, "a", 0.56, 0.3))
    faps = values(frames + advance(face, 1.0))[:, np.array(LIP_HEIGHT_FAPS) - 1][25:34]
    assert np.abs(faps[:, :6]).max(axis=1).min() < 12.0


def test_ignores_invalid_phones() -> None:
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


def test_ignores_flushed_and_outdated_phones() -> None:
    known = KnownPhones(INVENTORY)
    assert known.add_phone(phone(0, "a", 0.3, 0.1, final=False))
    assert known.add_phone(phone(0, "a", 0.3, 0.2))
    assert not known.add_phone(phone(0, "a", 0.3, 0.3, final=False))
    known.flush()
    assert not known.add_phone(phone(0, "a", 0.3, 0.4))
    assert known.add_phone(phone(1, "a", 0.6, 0.4))


def test_a_withdrawn_phone_does_not_move_the_face() -> None:
    face, other = make_face(), make_face()
    for animator in (face, other):
        animator.process(phone(0, "a", 0.3, 0.2))
    face.process(phone(1, "b", 0.5, 0.1, final=False))
    face.process(phone(1, "sil", 0.5, 0.0))
    np.testing.assert_array_equal(values(advance(face, 1.0)), values(advance(other, 1.0)))


def test_withdraws_phones_that_a_new_recognizer_does_not_confirm() -> None:
    face, plain = make_face(), make_face()
    for animator in (face, plain):
        speak(animator)
    face.change_recognizer()
    face.process(phone(0, "i", 0.4, 0.8))
    plain.process(phone(1, "i", 0.4, 0.8))
    after, revised = (values(advance(animator, 1.0)) for animator in (face, plain))
    np.testing.assert_allclose(after, revised, atol=1.0)


def test_resumes_without_a_known_frame() -> None:
    face = make_face(idle_motion_seed=5)
    face.resume(20.0, 1000)
    frames = advance(face, 20.1 + DELAY_S)
    assert frames[0][0] == pytest.approx(20.02)
    plain = advance(make_face(idle_motion_seed=5), 9.0)[-1]
    assert np.abs(frames[0][1] - plain[1]).max() > 0.0


def test_skips_frames_in_a_long_gap() -> None:
    face = make_face()
    last_s = speak(face)[-1][0]
    frames = advance(face, last_s + DELAY_S + 60.0)
    assert [time_s for time_s, _ in frames] == [pytest.approx(last_s + 60.0)]
    assert not values(frames).any()


def test_end_of_sound_completes_the_frames_and_leads_to_rest() -> None:
    face = make_face()
    frames = speak(face)
    frames += face.process(EndOfSound(time_s=0.95))
    np.testing.assert_allclose([time_s for time_s, _ in frames], np.arange(len(frames)) * FRAME_S)
    assert frames[-1][0] == pytest.approx(0.95 + REST_S, abs=FRAME_S)
    assert not frames[-1][1].round(1).any()


def test_rejects_settings_out_of_range() -> None:
    with pytest.raises(UserError, match="delay_s"):
        make_face(delay_s=1.6)
    with pytest.raises(UserError, match="frame_rate_hz"):
        make_face(frame_rate_hz=5.0)


def test_a_longer_delay_is_closer_to_the_full_model() -> None:
    spoken = [
        phone(i, symbol, 0.3 + 0.1 * i, 0.1)
        for i, symbol in enumerate("n i h ao b iao j u d an sh uo".split())
    ]
    whole = synthesize(LIPS, spoken, 90)
    errors = []
    for delay_s in (0.0, 0.1, 0.3):
        face = make_face(delay_s=delay_s)
        frames = []
        for animator in spoken:
            frames += advance(face, animator.onset_s + 0.05)
            face.process(animator)
        face.process(SpeechChange(active=False, time_s=1.5))
        frames += advance(face, 2.2)
        errors.append(float(np.sqrt(np.mean((values(frames)[:90] - whole) ** 2))))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.1 * errors[0]


def test_idle_motion_depends_on_the_seed_and_spares_the_mouth() -> None:
    with_motion = [make_face(idle_motion_seed=seed) for seed in (1, 1, 2)]
    one, same, other = (values(speak(face)) for face in with_motion)
    plain = values(speak(make_face()))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 100.0
    mouth = np.array(MOUTH_FAPS) - 1
    np.testing.assert_array_equal(one[:, mouth], plain[:, mouth])


def test_idle_motion_has_natural_statistics() -> None:
    motion, minutes, rate_hz = IdleMotion(7), 10, 50
    faps = np.zeros((minutes * 60 * rate_hz, 68), dtype=np.float32)
    for k, row in enumerate(faps):
        motion.apply(row, k / rate_hz, State.SPEAKING)
    closed = faps[:, 18] > 500.0
    assert 12 < np.count_nonzero(closed[1:] & ~closed[:-1]) / minutes < 24  # blinks per minute
    np.testing.assert_array_equal(faps[:, 18], faps[:, 19])
    head_deg = np.rad2deg(faps[:, 47:50] * 1e-5)
    assert (head_deg.std(axis=0) > 0.4).all()
    assert np.abs(head_deg).max() < 6.0
    assert np.abs(np.diff(head_deg, axis=0)).max() * rate_hz < 20.0  # degrees per second
    gaze_deg = np.rad2deg((faps[:, 22] + faps[:, 48]) * 1e-5)  # relative to space: eye and head
    assert np.median(np.abs(gaze_deg)) < 1.0
    assert 4.0 < np.abs(gaze_deg).max() <= 12.1


def test_eyes_move_while_media_time_stands_still() -> None:
    face = make_face(idle_motion_seed=3)
    advance(face, 0.2)
    assert values(face.relax(600))[:, 18].max() > 500.0  # a blink
