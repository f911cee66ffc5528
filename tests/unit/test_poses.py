"""The choice of the shown session, and the fade to rest without frames."""

import numpy as np
import pytest

from kouxing.services.driver.pose_store import PoseStore
from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.idle_motion import FADE_S


def faps(value: float) -> np.ndarray:
    return np.full(NUM_FAPS, value, np.float32)


def poses_of(*sessions: str, configured: str = "newest") -> PoseStore:
    """Return poses of sessions opened in order at 1 s, with FAPs 1, 2 and so on."""
    poses = PoseStore(configured)
    for number, session in enumerate(sessions, start=1):
        poses.add(session, 1.0)
        poses.update(session, faps(number), 1.0)
    return poses


def test_shows_the_newest_session_until_it_closes() -> None:
    poses = poses_of("a", "b", "c")
    shown = [poses.shown]
    for session in ("c", "a", "b"):
        poses.remove(session)
        shown.append(poses.shown)
    assert shown == ["c", "b", "b", ""]


def test_waits_for_a_named_session() -> None:
    poses = poses_of("a", configured="b")
    assert (poses.shown, poses.caption(0.0)) == ("", "waiting for b")
    poses.add("b", 0.0)
    assert poses.shown == "b"


def test_an_expression_shows_at_rest_and_fades() -> None:
    poses = PoseStore()
    corner = FAP_NUMBER["raise_l_cornerlip"] - 1
    assert poses.faps(0.0)[corner] == 0
    poses.express({"smile": 1.0, "unknown": 1.0}, hold_s=2.0)
    raised = [float(poses.faps(tick / 25)[corner]) for tick in range(1, 126)]
    assert raised[0] < 0.2 * raised[40] > 6
    assert raised[-1] < 0.01 * raised[40]


def test_a_stalled_face_fades_to_rest_and_returns() -> None:
    poses = poses_of("a")
    assert poses.faps(1.9)[0] == 1
    assert not poses.is_stalled(1.9)
    assert 0 < poses.faps(2.1)[0] < 1
    assert poses.is_stalled(2.1)
    assert poses.caption(2.1) == "a (no frames)"
    assert not poses.faps(3.0).any()
    for number in range(25):
        poses.update("a", faps(1), 3.0 + 0.02 * number)
        shown = poses.faps(3.0 + 0.02 * number)[0]
        assert shown == pytest.approx(min(0.02 * number / FADE_S, 1.0), abs=0.01)
    assert not poses.is_stalled(3.5)
