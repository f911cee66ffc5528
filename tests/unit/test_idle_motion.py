"""Brow, head and eye motion with speech."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.shared.face.faps import FAP_NUMBER, MOUTH_FAPS, NUM_FAPS
from kouxing.shared.face.idle_motion import IdleMotion
from kouxing.shared.phones.events import Progress, SpeechChange
from tests.lips import make_face

FRAME_S = 0.02
BROW = FAP_NUMBER["raise_l_m_eyebrow"] - 1
LID, GAZE = (FAP_NUMBER[name] - 1 for name in ("close_t_l_eyelid", "yaw_l_eyeball"))
YAW = FAP_NUMBER["head_yaw"] - 1
PITCH, ROLL = FAP_NUMBER["head_pitch"] - 1, FAP_NUMBER["head_roll"] - 1
QUIET_DB, SILENT_DB, STRESS_DB, STRONG_DB = -26.0, -80.0, -17.0, -8.0
SEEDS = range(1, 7)
DEGREE = np.deg2rad(1.0) * 1e5  # FAP units


def levels(*parts: tuple[float, float]) -> list[float]:
    """Return levels every 20 ms for parts given by duration and level."""
    return [level_db for duration_s, level_db in parts for _ in range(round(duration_s / FRAME_S))]


def animate(
    face: FaceAnimator,
    levels_db: Sequence[float],
    step: int = 1,
    pitches_hz: Sequence[float] | None = None,
) -> NDArray[np.float32]:
    """Return the frames for levels and pitches that arrive in chunks of a given size."""
    frames = face.process(SpeechChange(active=True, time_s=0.0))
    pitches_hz = pitches_hz or [0.0] * len(levels_db)
    events = [
        Progress(time_s=number * FRAME_S, level_db=level_db, pitch_hz=pitch_hz)
        for number, (level_db, pitch_hz) in enumerate(zip(levels_db, pitches_hz, strict=True), 1)
    ]
    for first in range(0, len(events), step):
        for event in events[first : first + step]:
            frames += face.process(event)
    return np.array([faps for _, faps in frames])


def added_motion(levels_db: Sequence[float], seed: int = 3) -> NDArray[np.float32]:
    """Return the difference from the motion with an even voice."""
    even = [QUIET_DB] * len(levels_db)
    spoken, plain = (
        animate(make_face(idle_motion_seed=seed), curve) for curve in (levels_db, even)
    )
    return spoken - plain


STRESSED, STRONG = (
    levels((1.0, QUIET_DB), (0.2, level_db), (0.8, QUIET_DB)) for level_db in (STRESS_DB, STRONG_DB)
)


def test_the_head_nods_on_stressed_syllables_and_brows_rise_on_the_strongest() -> None:
    stressed, strong = added_motion(STRESSED), added_motion(STRONG)
    np.testing.assert_array_equal(strong, added_motion(STRONG))
    assert not stressed[:, BROW].any()
    assert 20.0 < strong[:, BROW].max() < 60.0
    assert DEGREE / 2 < stressed[:, PITCH].max() < strong[:, PITCH].max() < 2.5 * DEGREE
    for curve in (strong[:, BROW], stressed[:, PITCH]):
        assert abs(FRAME_S * curve.argmax() - 1.15) < 0.2
    assert np.abs(np.diff(strong[:, BROW], n=2)).max() < 6.0  # no corners


def test_the_head_nods_at_the_end_of_a_phrase_and_tilts_after_a_question() -> None:
    sound = levels((2.0, QUIET_DB), (0.6, SILENT_DB))
    flat = [200.0] * 100 + [0.0] * 30
    rising = [200.0] * 85 + [200.0 * 2 ** (k / 15) for k in range(1, 16)] + [0.0] * 30
    statement, question = (
        animate(make_face(idle_motion_seed=3), sound, pitches_hz=pitches)
        for pitches in (flat, rising)
    )
    difference = question - statement
    assert np.abs(difference[:105, ROLL]).max() < 1.0
    assert np.abs(difference[105:, ROLL]).max() > 1.5 * DEGREE
    assert difference[105:, BROW].max() > 30.0
    even = animate(make_face(idle_motion_seed=3), [QUIET_DB] * len(sound))
    assert (statement - even)[100:, PITCH].max() > DEGREE / 2


def test_the_head_holds_still_in_pauses() -> None:
    pause = levels((1.0, QUIET_DB), (1.4, SILENT_DB), (10.0, SILENT_DB))
    faps = np.mean(
        [
            np.abs(np.diff(animate(make_face(idle_motion_seed=seed), pause)[:, ROLL]))
            for seed in SEEDS
        ],
        axis=0,
    )
    assert faps[110:170].mean() < 0.5 * faps[300:].mean()  # less than while listening later


def test_idle_motion_moves_no_lips_and_does_not_depend_on_chunks() -> None:
    sound = STRESSED + levels((0.5, SILENT_DB)) + STRESSED
    by_slice, in_chunks = (animate(make_face(idle_motion_seed=5), sound, step) for step in (1, 17))
    np.testing.assert_array_equal(by_slice, in_chunks)
    assert by_slice[:, BROW].any() or by_slice[:, PITCH].any()
    assert not by_slice[:, np.array(MOUTH_FAPS) - 1].any()
    assert not animate(make_face(), sound).any()  # seed 0: off


def gaze_deg(faps: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the horizontal gaze in space."""
    gaze: NDArray[np.float32] = (faps[:, GAZE] + faps[:, YAW]) / DEGREE
    return gaze


def test_the_gaze_leaves_the_viewer_when_speech_starts_and_returns_at_its_end() -> None:
    speech = levels((3.0, QUIET_DB), (0.8, SILENT_DB))
    away = np.mean(
        [
            np.abs(gaze_deg(animate(make_face(idle_motion_seed=s), speech))) > 1.5
            for s in range(1, 16)
        ],
        axis=0,
    )
    start, end = away[20:45].mean(), away[165:185].mean()
    assert start > 0.3
    assert end < 0.1


def test_a_listener_looks_at_the_viewer_and_nods_and_blinks_slowly_in_pauses() -> None:
    faps = []
    for seed in SEEDS:
        face = make_face(idle_motion_seed=seed)
        face.set_idle_motion(listening=True)
        relaxed = face.relax(500)
        face.set_idle_motion(listening=False)
        faps.append(np.array([values for _, values in relaxed + face.relax(50)]))
    away = np.abs([gaze_deg(run[:500]) for run in faps]) > 1.5
    assert away.mean() < 0.15
    for run in faps:
        assert run[500:, PITCH].max() - run[500, PITCH] > DEGREE / 2  # a nod
        assert np.count_nonzero(run[500:525, LID] > 450.0) >= 8  # a slow blink


def test_a_still_face_with_eye_contact_only_breathes_and_blinks() -> None:
    face = make_face(idle_motion_seed=3)
    face.set_idle_motion(still=True, eye_contact=True)
    faps = animate(face, STRONG * 5)[150:]
    assert not faps[:, BROW].any()
    assert np.abs(faps[:, [YAW, ROLL]]).max() < 0.15 * DEGREE
    assert 0.2 * DEGREE < np.ptp(faps[:, PITCH]) < DEGREE  # breath
    assert np.abs(gaze_deg(faps)).max() < 2.0
    assert faps[:, LID].max() > 800.0


def test_no_loop_can_be_seen_in_the_motion_of_a_minute() -> None:
    face = make_face(idle_motion_seed=3)
    faps = np.array([values for _, values in face.relax(3000)])
    for motion in (faps[:, YAW], faps[:, LID], gaze_deg(faps)):
        centered = motion - motion.mean()
        for lag in range(250, 1500, 25):
            assert np.corrcoef(centered[:-lag], centered[lag:])[0, 1] < 0.8
        assert np.ptp(motion[-250:]) > 0.0  # never frozen


def test_the_head_does_not_repeat_its_motion_within_a_minute() -> None:
    for seed in SEEDS:
        motion = IdleMotion(seed)
        faps = np.zeros((2500, NUM_FAPS), np.float32)  # 4 minutes
        for number, frame in enumerate(faps):
            motion.apply(frame, number / 10)
        for curve in faps[:, [PITCH, YAW, ROLL]].astype(np.float64).T:
            centered = curve - curve.mean()
            similarity = np.correlate(centered, centered, "full")[len(curve) - 1 :]
            assert similarity[30:600].max() < 0.5 * similarity[0]
