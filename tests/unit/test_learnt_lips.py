"""Learnt lips: a mouth that follows lip frames without a jerk, shuts for closures, and rests."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.learnt.closures import ClosingPhones, ClosureRule, shut_share
from kouxing.services.synthesizer.lips.learnt.model import LearntLips
from kouxing.services.synthesizer.lips.learnt.track import LipTrack
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import LipFrame, Phone, Progress, SpeechChange
from tests.lips import LIPS

pytestmark = pytest.mark.unit

MOUTH = np.array(MOUTH_FAPS) - 1
JAW, LOWER_LIP, TONGUE = 2, 4, 43  # columns of FAPs 3, 5, 44
HEIGHTS = np.array([4, 5, 8, 9, 10, 11]) - 1  # of the inner lips
DELAY_S = 0.1
LIPS_DELAY_S = 0.085
NEUTRAL = np.zeros(len(MOUTH_FAPS))
OPEN = {3: 300.0} | dict.fromkeys((4, 5, 8, 9, 10, 11, 51, 52, 55, 56, 57, 58), -200.0)


def lip_frame(
    time_s: float, opening: float = 1.0, closure: float = 0.0, lip_to_teeth: float = 0.0
) -> LipFrame:
    faps = np.zeros(len(MOUTH_FAPS), np.float32)
    for fap, value in OPEN.items():
        faps[MOUTH_FAPS.index(fap)] = opening * value
    return LipFrame(
        time_s=time_s,
        delay_s=LIPS_DELAY_S,
        faps=faps,
        closure=closure,
        lip_to_teeth=lip_to_teeth,
    )


def phone(symbol: str, onset_s: float, confidence: float = 0.95, index: int = 0) -> Phone:
    return Phone(
        index=index,
        symbol=symbol,
        onset_s=onset_s,
        duration_s=0.07,
        confidence=confidence,
        final=False,
    )


def make_face(frame_rate_hz: float = 50.0, delay_s: float = DELAY_S) -> FaceAnimator:
    return FaceAnimator(LearntLips(LIPS), frame_rate_hz=frame_rate_hz, delay_s=delay_s)


def run(
    face: FaceAnimator,
    begin_s: float,
    end_s: float,
    make: Callable[[float], LipFrame | None],
    phones: Sequence[tuple[float, Phone]] = (),
) -> list[Frame]:
    """Let the sound go on, with lip frames 5 ms before its slices, as a recognizer sends them."""
    frames = []
    for number in range(round(begin_s / 0.02) + 1, round(end_s / 0.02) + 1):
        now_s = number * 0.02
        for due_s, each in phones:
            if now_s - 0.02 < due_s <= now_s:
                face.process(each)
        lips = make(now_s - 0.005 - LIPS_DELAY_S)
        if lips is not None:
            frames += face.process(lips)
        frames += face.process(Progress(time_s=now_s, level_db=-20.0))
    return frames


def speak(face: FaceAnimator, begin_s: float = 0.0) -> None:
    face.process(SpeechChange(active=True, time_s=begin_s))


def values(frames: Sequence[Frame], column: int) -> NDArray[np.float64]:
    return np.array([faps[column] for _, faps in frames], dtype=float)


def at(frames: Sequence[Frame], time_s: float) -> NDArray[np.float32]:
    return min(frames, key=lambda frame: abs(frame[0] - time_s))[1]


def wave(time_s: float) -> LipFrame:
    return lip_frame(time_s, opening=0.5 - 0.5 * np.cos(2.0 * np.pi * 4.0 * time_s))


def nothing(_time_s: float) -> None:
    return None


def test_the_mouth_follows_the_lip_frames_in_time() -> None:
    face = make_face()
    speak(face)
    frames = [each for each in run(face, 0.0, 2.0, wave) if each[0] > 0.2]
    expected = [150.0 - 150.0 * np.cos(2.0 * np.pi * 4.0 * time_s) for time_s, _ in frames]
    assert np.abs(values(frames, JAW) - expected).max() < 0.04 * 300.0
    assert np.corrcoef(values(frames, LOWER_LIP), expected)[0, 1] < -0.999


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.1])
def test_position_and_velocity_are_continuous(delay_s: float) -> None:
    """Frames that are late, missing or sudden bring no jump and no corner at 240 per second."""
    face = make_face(frame_rate_hz=240.0, delay_s=delay_s)
    rng = np.random.default_rng(1)
    lost = {19, 20, 21, 40, 60, 61, 62, 63, 64, 65, 66, 67, 68, 69, 70}

    def make(time_s: float) -> LipFrame | None:
        number = round(time_s / 0.02)
        return None if number in lost else lip_frame(time_s, opening=0.3 + 0.4 * rng.random())

    frames = run(face, 0.0, 0.3, nothing)
    speak(face, 0.3)
    frames += run(face, 0.3, 2.0, make)
    face.process(SpeechChange(active=False, time_s=2.0))
    frames += run(face, 2.0, 2.5, nothing)
    jaw = values(frames, JAW)
    steps = np.diff(jaw)
    assert jaw.max() > 100.0
    assert np.abs(steps).max() < 0.12 * 300.0  # 4 ms
    # a corner would change the step at once by as much as the steepest one
    assert np.abs(np.diff(steps)).max() < 0.8 * np.abs(steps).max()


def test_silence_shuts_the_mouth_within_150_ms_and_nothing_twitches() -> None:
    face = make_face()
    speak(face)
    frames = run(face, 0.0, 1.0, lip_frame)
    assert at(frames, 0.8)[JAW] > 250.0
    last_s = 1.0 - 0.005 - LIPS_DELAY_S  # the newest lip frame
    face.process(SpeechChange(active=False, time_s=1.0))
    frames += run(face, 1.0, 3.0, nothing)
    jaw = values([each for each in frames if each[0] >= last_s], JAW)
    assert (np.diff(jaw) <= 1e-4).all()
    late = [faps for time_s, faps in frames if time_s > last_s + 0.15]
    assert len(late) > 50
    assert not np.array(late)[:, MOUTH].any()


def test_lips_that_fall_silent_without_a_word_are_at_rest_within_150_ms() -> None:
    face = make_face()
    speak(face)
    last_s = 1.0 - 0.005 - LIPS_DELAY_S
    frames = run(face, 0.0, 1.0, lip_frame) + run(face, 1.0, 2.0, nothing)
    assert at(frames, last_s)[JAW] > 290.0
    assert not np.array([faps for time_s, faps in frames if time_s > last_s + 0.151]).any()


def test_a_frame_that_is_late_changes_little() -> None:
    frames = []
    for lost in (-1, 25):
        face = make_face()
        speak(face)

        def make(time_s: float, lost: int = lost) -> LipFrame | None:
            return None if round(time_s / 0.02) == lost else wave(time_s)

        frames.append(run(face, 0.0, 1.0, make))
    assert np.abs(values(frames[0], JAW) - values(frames[1], JAW)).max() < 30.0


def test_the_sound_alone_shuts_the_lips_whatever_phone_is_recognised() -> None:
    face = make_face()
    speak(face)

    def make(time_s: float) -> LipFrame:
        return lip_frame(time_s, closure=0.95 if 0.46 < time_s < 0.54 else 0.02)

    frames = run(face, 0.0, 1.0, make, [(0.5, phone("t", 0.47))])
    assert np.abs(at(frames, 0.5)[HEIGHTS]).max() < 10.0
    assert at(frames, 0.5)[JAW] > 250.0  # lips meet while the jaw stays
    assert np.abs(at(frames, 0.4)[HEIGHTS] + 200.0).max() < 1.0
    assert np.abs(at(frames, 0.6)[HEIGHTS] + 200.0).max() < 1.0


@pytest.mark.parametrize(
    ("closure", "confidence", "shuts"),
    [(0.1, 0.95, True), (0.1, 0.5, False), (0.003, 0.95, False), (0.95, 0.5, True)],
)
def test_sound_and_phone_decide_a_closure_together(
    closure: float, confidence: float, shuts: bool
) -> None:
    face = make_face()
    speak(face)

    def make(time_s: float) -> LipFrame:
        return lip_frame(time_s, closure=closure if 0.46 < time_s < 0.54 else 0.01)

    frames = run(face, 0.0, 1.0, make, [(0.52, phone("p", 0.46, confidence))])
    height = np.abs(at(frames, 0.5)[HEIGHTS]).max()
    assert height < 10.0 if shuts else height > 190.0


def test_no_closure_flutters() -> None:
    face = make_face()
    speak(face)

    def make(time_s: float) -> LipFrame:
        return lip_frame(time_s, closure=0.99 if abs(time_s - 0.51) < 0.01 else 0.01)

    frames = run(face, 0.0, 1.0, make)
    # Lips meet at 0.51 and 0.53 s, between two frames each.
    assert np.abs(at(frames, 0.52)[HEIGHTS]).max() < 40.0
    assert np.abs(at(frames, 0.54)[HEIGHTS]).max() < 100.0
    assert np.abs(at(frames, 0.58)[HEIGHTS]).min() == pytest.approx(200.0, abs=1.0)


def test_a_phone_that_comes_after_its_onset_shuts_the_lips_all_the_same() -> None:
    face = make_face(delay_s=0.06)
    speak(face)

    def make(time_s: float) -> LipFrame:
        return lip_frame(time_s + LIPS_DELAY_S - 0.055, closure=0.1)

    # known when the mouth of 0.54 s is made, 80 ms after the onset
    frames = run(face, 0.0, 1.0, make, [(0.6, phone("p", 0.46))])
    heights = [float(np.abs(faps[HEIGHTS]).max()) for _, faps in frames]
    assert min(heights[round(0.54 * 50) : round(0.6 * 50)]) < 10.0
    assert min(heights[round(0.3 * 50) : round(0.53 * 50)]) > 190.0


def test_a_phone_that_is_taken_back_shuts_nothing() -> None:
    face = make_face()
    speak(face)

    def make(time_s: float) -> LipFrame:
        return lip_frame(time_s, closure=0.1)

    phones = [(0.5, phone("m", 0.46)), (0.52, phone("n", 0.46))]
    frames = run(face, 0.0, 1.0, make, phones)
    assert np.abs(at(frames, 0.5)[HEIGHTS]).min() > 150.0


def test_f_brings_the_lower_lip_alone_to_the_teeth() -> None:
    face = make_face()
    speak(face)
    frames = run(face, 0.0, 1.0, lip_frame, [(0.5, phone("f", 0.46))])
    assert at(frames, 0.5)[LOWER_LIP] > -10.0
    assert at(frames, 0.5)[3] == pytest.approx(-200.0)  # FAP 4, upper lip


def test_closing_is_no_jerk() -> None:
    face = make_face(frame_rate_hz=240.0)
    speak(face)

    def make(time_s: float) -> LipFrame:
        return lip_frame(time_s, closure=1.0 if 0.47 < time_s < 0.53 else 0.0)

    lip = values(run(face, 0.2, 1.0, make), LOWER_LIP)
    steps = np.diff(lip[60:])
    assert np.abs(steps).max() > 20.0
    assert np.abs(np.diff(steps)).max() < 0.8 * np.abs(steps).max()


def test_the_tongue_comes_from_the_visemes_and_the_lips_do_not() -> None:
    def tongue_of(face: FaceAnimator) -> list[Frame]:
        speak(face)
        phones = [(0.4, phone("d", 0.35, index=0)), (0.5, phone("a", 0.42, index=1))]
        return run(face, 0.0, 1.0, lambda time_s: lip_frame(time_s, opening=0.0), phones)

    learnt = tongue_of(make_face())
    visemes = tongue_of(FaceAnimator(LIPS, frame_rate_hz=50.0, delay_s=DELAY_S))
    tongue = values(learnt, TONGUE)
    np.testing.assert_array_equal(tongue, values(visemes, TONGUE))
    assert np.abs(tongue).max() > 50.0
    assert not values(learnt, JAW).any()
    assert values(visemes, JAW).max() > 50.0


def test_the_level_does_not_scale_what_already_follows_the_sound() -> None:
    jaws = []
    for level_db in (-40.0, -10.0):
        face = make_face()
        speak(face)
        frames = []
        for number in range(1, 60):
            face.process(lip_frame(number * 0.02 - 0.005 - LIPS_DELAY_S))
            frames += face.process(Progress(time_s=number * 0.02, level_db=level_db))
        jaws.append(values(frames, JAW))
    np.testing.assert_array_equal(jaws[0], jaws[1])


def test_flush_returns_to_rest_within_150_ms_and_ignores_what_was_on_its_way() -> None:
    face = make_face()
    speak(face)
    before = run(face, 0.0, 1.0, lip_frame)
    face.flush()
    after = run(face, 1.0, 1.28, lip_frame)
    late = [faps for time_s, faps in after if time_s > before[-1][0] + 0.15]
    assert late
    assert not np.array(late).round(3).any()
    assert after[0][1][JAW] > 150.0  # and it does not jump there
    face.process(SpeechChange(active=False, time_s=1.3))
    speak(face, 1.3)
    assert values(run(face, 1.3, 1.7, lip_frame), JAW)[-1] > 250.0


def test_relax_leads_to_rest_and_back_without_a_jump() -> None:
    face = make_face()
    speak(face)
    frames = run(face, 0.0, 1.0, lip_frame)
    frames += face.relax(10)
    assert not frames[-1][1].round(3).any()
    frames += run(face, 1.0, 1.4, lip_frame)
    assert frames[-1][1][JAW] > 250.0
    assert np.abs(np.diff(values(frames[20:], JAW))).max() < 120.0


def test_nonsense_is_dropped() -> None:
    face = make_face()
    speak(face)
    frames = run(face, 0.0, 0.5, lip_frame)
    for bad in (
        lip_frame(np.nan),
        lip_frame(0.42, opening=np.inf),
        lip_frame(0.42, opening=1e6),
        lip_frame(0.42, closure=np.nan),
        lip_frame(0.1, opening=-5.0),  # older than what is known
    ):
        face.process(bad)
    frames += run(face, 0.5, 1.0, lip_frame)
    assert np.isfinite(np.array([faps for _, faps in frames])).all()
    assert np.abs(values(frames[15:40], JAW) - 300.0).max() < 1.0


def test_without_any_lip_frame_the_visemes_move_the_mouth() -> None:
    faces = (make_face(), FaceAnimator(LIPS, frame_rate_hz=50.0, delay_s=DELAY_S))
    jaws = []
    for face in faces:
        speak(face)
        phones = [(0.4, phone("d", 0.35, index=0)), (0.5, phone("a", 0.42, index=1))]
        jaws.append(values(run(face, 0.0, 0.6, nothing, phones), JAW))
    assert jaws[0].max() > 50.0
    assert np.corrcoef(jaws[0], jaws[1])[0, 1] > 0.99
    frames = run(faces[0], 0.6, 1.0, lip_frame)
    assert frames[-1][1][JAW] == pytest.approx(300.0)
    assert np.abs(np.diff(values(frames, JAW))).max() < 150.0


def test_a_track_passes_through_its_frames_without_a_corner() -> None:
    rng = np.random.default_rng(2)
    track, values = LipTrack(NEUTRAL), rng.normal(size=(8, len(MOUTH_FAPS)))
    for number, value in enumerate(values):
        track.append(1.0 + number / 50.0, value)
    track.hold_s = 0.04
    found = [track.at(1.0 + number / 50.0).value for number in range(8)]
    np.testing.assert_allclose(found, values, atol=1e-9)
    step = 1e-6
    for time_s in np.linspace(0.9, 1.4, 101) + step / 3.0:  # at each frame, too, and beyond
        before, here, after = (track.at(float(time_s + k * step)) for k in (-1, 0, 1))
        np.testing.assert_allclose(
            here.velocity, (after.value - before.value) / (2 * step), atol=1e-2
        )
    assert not track.at(0.94).value.any()
    assert not track.at(1.28).value.any()


def test_a_frame_that_comes_does_not_change_what_was_before() -> None:
    track = LipTrack(NEUTRAL)
    times, shown = np.linspace(0.0, 0.1, 51), np.full(51, np.nan)
    for number in range(6):
        track.append(number / 50.0, NEUTRAL + number % 3)
        now = np.array([track.at(float(time_s)).value[0] for time_s in times])
        known = ~np.isnan(shown)
        np.testing.assert_array_equal(now[known], shown[known])
        shown = np.where(times <= number / 50.0, now, np.nan)


def test_trembling_is_steadied_and_movement_is_not() -> None:
    face = make_face()
    speak(face)

    def make(time_s: float) -> LipFrame:
        trembling = 0.01 * (-1.0) ** round(time_s / 0.02)  # of 300 FAP units
        return lip_frame(time_s, opening=(0.5 if time_s < 1.0 else 1.0) + trembling)

    frames = run(face, 0.0, 2.0, make)
    for begin_s, end_s in ((0.5, 0.9), (1.1, 1.8)):
        jaw = values([each for each in frames if begin_s < each[0] < end_s], JAW)
        assert np.abs(np.diff(jaw)).max() < 0.25 * 6.0
    assert at(frames, 0.98)[JAW] == pytest.approx(150.0, abs=5.0)
    assert at(frames, 1.04)[JAW] == pytest.approx(300.0, abs=5.0)


def test_lips_do_not_pass_through_each_other() -> None:
    face = make_face()
    speak(face)
    frames = run(face, 0.0, 1.0, lambda time_s: lip_frame(time_s, opening=-0.2))
    faps = at(frames, 0.8)
    np.testing.assert_allclose(faps[HEIGHTS[::2]] + faps[HEIGHTS[1::2]], 0.0, atol=1.0)


def test_phones_are_no_evidence_against_a_closure() -> None:
    phones = ClosingPhones(LIPS.inventory, "b", ClosureRule(phone=3.0))
    log_odds = [phones.log_odds(0.5)]
    phones.add(phone("t", 0.46), 0.4)
    log_odds.append(phones.log_odds(0.5))
    assert log_odds == [0.0, 0.0]
    phones.add(phone("p", 0.46, index=1), 0.4)
    assert phones.log_odds(0.5) > 2.0
    assert [shut_share(odds, 1.0) for odds in (-1.0, 0.0, 1.0)] == [0.0, 0.5, 1.0]


def test_of_recordings_other_phones_are_evidence_against_a_closure() -> None:
    phones = ClosingPhones(LIPS.inventory, "b", ClosureRule(phone=3.0, other=2.0))
    phones.add(phone("t", 0.46), 0.0)
    phones.add(phone("sil", 0.7, index=1), 0.0)
    assert phones.log_odds(0.5) == -2.0
    assert phones.log_odds(0.72) == 0.0
    phones.add(phone("p", 0.48, index=2), 0.0)
    assert phones.log_odds(0.5) > 2.0


@pytest.mark.parametrize("doubtful", [{4: -100.0, 5: -100.0}, {6: -100.0, 7: -100.0}])
def test_lips_told_apart_or_rounded_are_shut_for_a_phone_rather_than_for_the_sound(
    doubtful: dict[int, float],
) -> None:
    rule = ClosureRule()
    nearly_shut, other = np.zeros((2, len(MOUTH_FAPS)))
    other[[MOUTH_FAPS.index(fap) for fap in doubtful]] = list(doubtful.values())
    assert rule.log_odds(other, 0.0, 0.0) < rule.log_odds(nearly_shut, 0.0, 0.0) - 1.0
    supported = [rule.log_odds(mouth, 0.0, rule.phone) for mouth in (nearly_shut, other)]
    assert supported[0] == supported[1] == rule.sound + rule.phone


def test_learnt_lips_are_found_by_name() -> None:
    assert isinstance(load_lip_model(name="learnt"), LearntLips)


@pytest.mark.parametrize("to_learnt", [True, False])
def test_another_lip_model_goes_on_from_where_the_mouth_is(to_learnt: bool) -> None:
    models = (LIPS, LearntLips(LIPS))
    first, second = models if to_learnt else models[::-1]
    frames = []
    for changes in (True, False):
        face = FaceAnimator(first if changes else second, frame_rate_hz=240.0, delay_s=DELAY_S)
        speak(face)
        phones = [
            (0.02 + 0.1 * index, phone(symbol, 0.1 * index, index=index))
            for index, symbol in enumerate(["d", "a", "sh", "i", "g", "u", "d", "a", "g", "u"])
        ]
        shown = run(face, 0.0, 0.6, wave, phones[:6])
        if changes:
            face.set_lip_model(second)
            face.set_lip_model(second)
        frames.append(shown + run(face, 0.6, 1.2, wave, phones[6:]))
    changed = values(frames[0], JAW)
    steps = np.diff(changed)
    here = round((0.6 - DELAY_S) * 240)
    assert np.abs(np.diff(steps[here - 6 : here + 12])).max() < 15.0  # no jump, no corner
    # a while later it is as if it had been used from the beginning
    np.testing.assert_allclose(changed[-60:], values(frames[1], JAW)[-60:], atol=20.0)
    assert np.abs(changed[:here] - values(frames[1], JAW)[:here]).max() > 50.0
