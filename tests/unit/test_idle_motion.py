"""Brow, head and eye motion with speech."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.shared.face.faps import FAP_NUMBER, MOUTH_FAPS
from kouxing.shared.phones.events import Progress, SpeechChange
from tests.lips import make_face

FRAME_S = 0.02
BROW = FAP_NUMBER["raise_l_m_eyebrow"] - 1
PITCH = FAP_NUMBER["head_pitch"] - 1
QUIET_DB, SILENT_DB, STRESS_DB = -26.0, -80.0, -14.0


def levels(*parts: tuple[float, float]) -> list[float]:
    """Return levels every 20 ms for parts given by duration and level."""
    return [level_db for duration_s, level_db in parts for _ in range(round(duration_s / FRAME_S))]


def show(face: FaceAnimator, levels_db: Sequence[float], step: int = 1) -> NDArray[np.float32]:
    """Return the frames for levels that arrive in chunks of a given size."""
    frames = face.process(SpeechChange(active=True, time_s=0.0))
    for first in range(0, len(levels_db), step):
        for number, level_db in enumerate(levels_db[first : first + step], start=first + 1):
            frames += face.process(Progress(time_s=number * FRAME_S, level_db=level_db))
    return np.array([faps for _, faps in frames])


def lively(levels_db: Sequence[float], seed: int) -> NDArray[np.float32]:
    """Return the difference from idle motion without speech."""
    flat = [QUIET_DB] * len(levels_db)
    spoken, plain = (show(make_face(idle_motion_seed=seed), curve) for curve in (levels_db, flat))
    return spoken - plain


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


def test_does_not_move_lips_and_is_independent_of_chunks() -> None:
    sound = STRESSED + levels((0.5, SILENT_DB)) + STRESSED
    one, other = (show(make_face(idle_motion_seed=5), sound, step) for step in (1, 17))
    np.testing.assert_array_equal(one, other)
    assert one[:, BROW].any() or one[:, PITCH].any()
    assert not one[:, np.array(MOUTH_FAPS) - 1].any()
    assert not show(make_face(), sound).any()  # seed 0: off
