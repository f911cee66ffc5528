"""A live face: its mouth, idle motion and amplitude."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import find_peaks

from kouxing.evaluation.lips.offline_visemes import synthesize
from kouxing.services.synthesizer.face_animator import REST_S, FaceAnimator, Frame
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.idle_motion import ConversationState, IdleMotion
from kouxing.shared.phones.events import AudioSkipped, EndOfSound, Progress, SpeechChange
from tests.lips import DELAY_S, LIPS, advance, make_face, phone

JAW = 2
MOUTH_CORNERS = [11, 12]  # FAP 12 and 13: upwards
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


def test_a_long_vowel_stays_open_without_new_phones() -> None:
    face = make_face(delay_s=0.06)
    face.process(SpeechChange(active=True, time_s=0.3))
    before = advance(face, 0.41)  # recognition takes 0.1 s
    face.process(phone(0, "a", 0.3, 0.15, final=False))
    jaw = values(before + advance(face, 1.6))[:72, JAW]
    # it rises without falling back, then stays
    assert (np.maximum.accumulate(jaw) - jaw).max() < 0.1 * jaw.max()
    assert jaw[35:].min() > 0.95 * jaw.max() > 240.0


def test_the_face_relaxes_and_returns_without_a_jump() -> None:
    face = make_face()
    spoken = speak(face)
    rest = face.relax(10) + face.relax(10)
    assert {time_s for time_s, _ in rest} == {spoken[-1][0]}
    assert not rest[-1][1].round(3).any()
    face.process(phone(1, "a", 0.4, 0.9))
    faps = values(spoken[-2:] + rest + advance(face, 1.2))
    assert faps[-1, JAW] > 100.0
    assert np.abs(np.diff(faps[:, JAW])).max() < 200.0


def test_an_old_phone_can_be_withdrawn_after_an_interruption() -> None:
    face = make_face()
    speak(face)  # ends with an open vowel at 0.4 s
    advance(face, 3.0)
    face.flush()
    face.change_recognizer()
    assert values(face.relax(20))[-1, JAW] < 1.0


def test_skips_to_newer_audio_without_a_jump() -> None:
    face = make_face(idle_motion_seed=3)
    spoken = speak(face)
    assert face.process(AudioSkipped(time_s=31.0)) == []
    after = advance(face, 31.5)
    assert after[0][0] == pytest.approx(31.0 - DELAY_S, abs=FRAME_S)
    assert len(after) == pytest.approx(0.5 / FRAME_S, abs=1)
    faps = values(spoken[-1:] + after)
    assert faps[0, JAW] > 100.0
    assert faps[-1, JAW] < 1.0
    assert np.abs(np.diff(faps[:, JAW])).max() < faps[0, JAW] / 3


def test_events_from_before_a_long_gap_may_be_repeated() -> None:
    face = make_face()
    frames = advance(face, 1.0) + advance(face, 15.0) + advance(face, 15.2)
    face.change_recognizer()
    face.process(SpeechChange(active=False, time_s=1.0))
    frames += advance(face, 15.1) + advance(face, 15.3)
    times_s = [time_s for time_s, _ in frames]
    assert times_s == sorted({*times_s})
    assert times_s[-1] == pytest.approx(15.3 - DELAY_S, abs=FRAME_S)


def test_a_breath_parts_the_lips_only_without_speech() -> None:
    faces = []
    for is_speaking in (False, True):
        face = make_face()
        if is_speaking:
            face.process(SpeechChange(active=True, time_s=0.0))
        faps = [
            values
            for number in range(80)
            for _, values in face.process(
                Progress(time_s=number * FRAME_S, level_db=-40.0, is_breath=number > 40)
            )
        ]
        faces.append(np.array(faps)[:, JAW].max())
    breathing, speaking = faces
    assert breathing > 60.0
    assert speaking == 0.0


def test_the_face_laughs_while_the_voice_laughs() -> None:
    face = make_face()
    faps = []
    for number in range(250):
        time_s = number * FRAME_S
        progress = Progress(time_s=time_s, level_db=-20.0, is_laughter=0.5 <= time_s < 1.0)
        faps += values(face.process(progress)).reshape(-1, NUM_FAPS).tolist()
    corners = np.array(faps)[:, MOUTH_CORNERS].mean(axis=1)
    shown = round((0.5 - DELAY_S) / FRAME_S)  # the first frame of the laughter
    assert not corners[: shown - 1].any()
    assert corners[shown : shown + 25].max() > 100.0
    assert np.array(faps)[shown : shown + 25, JAW].max() > 150.0
    assert abs(corners[-1]) < 1.0


def test_the_mouth_follows_the_notes_of_a_laugh_and_the_pauses_between_them() -> None:
    face = make_face()
    jaw = []
    for number in range(400):
        time_s = number * FRAME_S
        is_note = time_s % 0.22 < 0.12 and time_s % 2.0 < 1.5  # "ha" 4.5 times a second
        progress = Progress(time_s=time_s, level_db=-20.0 if is_note else -45.0, is_laughter=True)
        jaw += [faps[JAW] for _, faps in face.process(progress)]
    notes = [jaw[start : start + 70] for start in (104, 204, 304)]
    pauses = [jaw[start : start + 15] for start in (82, 182, 282)]
    for note, pause in zip(notes, pauses, strict=True):
        peaks, _ = find_peaks(note, prominence=15.0)
        assert 5 <= len(peaks) <= 7
        assert max(pause) < 0.5 * max(note)
    assert np.abs(np.diff(jaw)).max() < 0.2 * max(jaw)  # it does not flutter


def test_end_of_sound_completes_the_frames_and_leads_to_rest() -> None:
    face = make_face()
    frames = speak(face)
    frames += face.process(EndOfSound(time_s=0.95))
    np.testing.assert_allclose([time_s for time_s, _ in frames], np.arange(len(frames)) * FRAME_S)
    assert frames[-1][0] == pytest.approx(0.95 + REST_S, abs=FRAME_S)
    assert not frames[-1][1].round(1).any()


def test_a_longer_delay_is_closer_to_the_full_model() -> None:
    spoken = [
        phone(i, symbol, 0.3 + 0.1 * i, 0.1)
        for i, symbol in enumerate("n i h ao b iao j u d an sh uo".split())
    ]
    offline = synthesize(LIPS, spoken, 90)
    errors = []
    for delay_s in (0.0, 0.1, 0.3):
        face = make_face(delay_s=delay_s)
        frames = []
        for animator in spoken:
            frames += advance(face, animator.onset_s + 0.05)
            face.process(animator)
        face.process(SpeechChange(active=False, time_s=1.5))
        frames += advance(face, 2.2)
        errors.append(float(np.sqrt(np.mean((values(frames)[:90] - offline) ** 2))))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.1 * errors[0]


def test_idle_motion_has_natural_statistics() -> None:
    motion, minutes, rate_hz = IdleMotion(7), 10, 50
    faps = np.zeros((minutes * 60 * rate_hz, 68), dtype=np.float32)
    for k, row in enumerate(faps):
        motion.apply(row, k / rate_hz, ConversationState.SPEAKING)
    closed = faps[:, 18] > 500.0
    assert 12 < np.count_nonzero(closed[1:] & ~closed[:-1]) / minutes < 24  # blinks per minute
    np.testing.assert_array_equal(faps[:, 18], faps[:, 19])
    head_deg = np.rad2deg(faps[:, 47:50] * 1e-5)
    assert (head_deg.std(axis=0) > 0.15).all()
    assert np.abs(head_deg).max() < 6.0
    assert np.abs(np.diff(head_deg, axis=0)).max() * rate_hz < 20.0  # degrees per second
    gaze_deg = np.rad2deg((faps[:, 22] + faps[:, 48]) * 1e-5)  # relative to space: eye and head
    assert np.median(np.abs(gaze_deg)) < 1.0
    assert 4.0 < np.abs(gaze_deg).max() <= 12.1
