"""Brow, head and eye motion with speech."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.shared.face.faps import FAP_NUMBER, MOUTH_FAPS
from kouxing.shared.face.idle_motion import IdleMotion, State
from kouxing.shared.phones.events import Progress, SpeechChange
from tests.lips import make_face

pytestmark = pytest.mark.unit

FRAME_S = 0.02
BROW = FAP_NUMBER["raise_l_m_eyebrow"] - 1
PITCH, YAW = (FAP_NUMBER[f"head_{axis}"] - 1 for axis in ("pitch", "yaw"))
EYE_PITCH, EYE_YAW = (FAP_NUMBER[f"{axis}_l_eyeball"] - 1 for axis in ("pitch", "yaw"))
QUIET_DB, SILENT_DB, STRESS_DB = -26.0, -80.0, -14.0


def levels(*parts: tuple[float, float]) -> list[float]:
    """Return levels every 20 ms for parts given by duration and level."""
    return [level_db for duration_s, level_db in parts for _ in range(round(duration_s / FRAME_S))]


def show(
    face: FaceAnimator, levels_db: Sequence[float], step: int = 1, pitch_hz: Sequence[float] = ()
) -> NDArray[np.float32]:
    """Return the frames for levels and pitches that arrive in chunks of a given size."""
    pitch_hz = pitch_hz or [0.0] * len(levels_db)
    frames = face.process(SpeechChange(active=True, time_s=0.0))
    for first in range(0, len(levels_db), step):
        for number in range(first, min(first + step, len(levels_db))):
            progress = Progress(
                time_s=(number + 1) * FRAME_S,
                level_db=levels_db[number],
                pitch_hz=pitch_hz[number],
            )
            frames += face.process(progress)
    return np.array([faps for _, faps in frames])


def lively(levels_db: Sequence[float], seed: int) -> NDArray[np.float32]:
    """Return the difference from idle motion without speech."""
    flat = [QUIET_DB] * len(levels_db)
    return show(make_face(idle_motion_seed=seed), levels_db) - show(
        make_face(idle_motion_seed=seed), flat
    )


STRESSED = levels((1.0, QUIET_DB), (0.2, STRESS_DB), (0.8, QUIET_DB))


def test_brows_and_head_move_on_stressed_syllables() -> None:
    added = [lively(STRESSED, seed) for seed in range(1, 21)]
    raised = [faps[:, BROW] for faps in added]
    heights = np.array([curve.max() for curve in raised])
    assert 6 < np.count_nonzero(heights > 10.0) < 18  # not on every stress
    assert heights.max() < 60.0  # a small movement
    peaks_s = FRAME_S * np.array([curve.argmax() for curve in raised if curve.max() > 10.0])
    assert (np.abs(peaks_s - 1.15) < 0.2).all()
    assert all(np.abs(np.diff(curve, n=2)).max() < 5.0 for curve in raised)  # no corners
    dips = np.array([faps[:, PITCH].max() for faps in added])
    assert 8 < np.count_nonzero(dips > 500.0) < 20
    assert dips.max() < np.deg2rad(2.5) * 1e5


def test_a_raised_pitch_is_stress() -> None:
    levels_db = levels((1.0, QUIET_DB), (0.2, QUIET_DB + 3.0), (0.8, QUIET_DB))
    pitch_hz = levels((1.0, 200.0), (0.2, 280.0), (0.8, 200.0))
    raised, level = (
        [
            show(make_face(idle_motion_seed=seed), levels_db, pitch_hz=voice)[:, BROW].max() > 10.0
            for seed in range(1, 21)
        ]
        for voice in (pitch_hz, [200.0] * len(levels_db))
    )
    assert sum(raised) > 5
    assert sum(level) == 0


def test_nods_at_the_end_of_a_phrase() -> None:
    phrase = levels((1.5, QUIET_DB), (0.4, SILENT_DB))
    nods = np.array([lively(phrase, seed) for seed in range(1, 21)])
    depth_deg = np.rad2deg(nods[:, 75:, PITCH].max(axis=1) * 1e-5)
    assert 12 < np.count_nonzero(depth_deg > 0.4) < 20
    assert depth_deg.max() < 2.5
    gaze = nods[:, :, PITCH] + nods[:, :, EYE_PITCH]
    assert np.median(np.abs(gaze[:, 75:])) < 1.0
    short = levels((0.5, QUIET_DB), (0.4, SILENT_DB))
    assert max(lively(short, seed)[:, PITCH].max() for seed in range(1, 11)) < 100.0


def test_does_not_move_lips_and_is_independent_of_chunks() -> None:
    sound = STRESSED + levels((0.5, SILENT_DB)) + STRESSED
    one, other = (show(make_face(idle_motion_seed=5), sound, step) for step in (1, 17))
    np.testing.assert_array_equal(one, other)
    assert one[:, BROW].any() or one[:, PITCH].any()
    assert not one[:, np.array(MOUTH_FAPS) - 1].any()
    assert not show(make_face(), sound).any()  # seed 0: off


def test_noise_does_not_move_brows() -> None:
    face = make_face(idle_motion_seed=5)
    frames = [
        faps
        for number, level_db in enumerate(STRESSED)
        for _, faps in face.process(Progress(time_s=(number + 1) * FRAME_S, level_db=level_db))
    ]
    assert not np.array(frames)[:, BROW].any()


def test_eyes_look_away_more_often_in_pauses() -> None:
    def share_on_viewer(state: State) -> float:
        motion = IdleMotion(3)
        faps = np.zeros((3000, 68), np.float32)
        for number, row in enumerate(faps):
            motion.apply(row, number * 0.1, state)
        gaze_deg = np.rad2deg((faps[:, [EYE_YAW, EYE_PITCH]] + faps[:, [YAW, PITCH]]) * 1e-5)
        return float((np.abs(gaze_deg).max(axis=1) < 1.7).mean())

    assert share_on_viewer(State.SPEAKING) > 0.8
    assert share_on_viewer(State.LISTENING) > 0.7
    assert share_on_viewer(State.THINKING) < 0.65
