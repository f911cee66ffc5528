"""Which session's face is shown, and how it goes to rest when frames stop."""

from __future__ import annotations

import numpy as np
import pytest

from services.driver.poses import Poses
from shared.face.faps import NUM_FAPS

pytestmark = pytest.mark.unit


def faps(value: float) -> np.ndarray:
    return np.full(NUM_FAPS, value, np.float32)


def poses_of(*sessions: str, configured: str = "newest") -> Poses:
    """Poses of sessions opened in this order; the FAPs of each are its number, from 1."""
    poses = Poses(configured)
    for number, session in enumerate(sessions, start=1):
        poses.add(session, 0.0)
        poses.accept_frame(session, faps(number), 0.0)
    return poses


def test_frames_of_two_sessions_do_not_mix() -> None:
    poses = poses_of("a", "b")
    for number in range(10):
        poses.accept_frame("a", faps(100), 0.02 * number)
        poses.accept_frame("b", faps(200), 0.02 * number)
        assert poses.faps(0.02 * number)[0] == 200


def test_the_newest_is_shown_until_it_closes() -> None:
    poses = poses_of("a", "b", "c")
    shown = [poses.shown]
    for session in ("c", "a", "b"):
        poses.remove(session)
        shown.append(poses.shown)
    assert shown == ["c", "b", "b", ""]


def test_a_named_session_is_waited_for() -> None:
    poses = poses_of("a", configured="b")
    assert (poses.shown, poses.caption(0.0)) == ("", "waiting for b")
    assert poses.faps(0.0)[0] == 0
    poses.add("b", 0.0)
    poses.add("c", 0.0)
    assert poses.shown == "b"


def test_switching_goes_round_and_holds_until_the_session_closes() -> None:
    poses = poses_of("a", "b", "c")
    shown = []
    for step in (1, 1, -1, -1, -1):
        poses.switch(step)
        shown.append(poses.shown)
    assert shown == ["a", "b", "a", "c", "b"]
    poses.add("d", 0.0)
    assert poses.shown == "b", "the user's choice is kept"
    poses.remove("b")
    assert poses.shown == "d"


def test_back_at_the_newest_new_sessions_are_shown_again() -> None:
    poses = poses_of("a", "b")
    poses.switch(1)
    poses.switch(1)
    poses.add("c", 0.0)
    assert poses.shown == "c"


@pytest.mark.parametrize(("step", "shown"), [(1, "a"), (-1, "b")])
def test_switching_works_while_the_named_session_is_awaited(step: int, shown: str) -> None:
    poses = poses_of("a", "b", configured="other")
    poses.switch(step)
    assert poses.shown == shown


def test_without_sessions_a_switch_does_nothing() -> None:
    poses = Poses()
    poses.switch(1)
    assert poses.shown == ""


def test_a_stalled_face_fades_to_rest_and_comes_back() -> None:
    poses = poses_of("a")
    assert poses.faps(0.9)[0] == 1
    assert not poses.is_stalled(0.9)
    assert 0 < poses.faps(1.2)[0] < 1
    assert poses.is_stalled(1.2)
    assert poses.caption(1.2) == "a (no frames come)"
    assert not poses.faps(2.0).any()
    poses.accept_frame("a", faps(1), 3.0)
    assert poses.faps(3.0)[0] == 1
    assert not poses.is_stalled(3.0)


def test_a_face_that_has_ended_rests_without_a_remark() -> None:
    poses = poses_of("a")
    poses.end("a")
    assert not poses.faps(2.0).any()
    assert poses.caption(2.0) == "a"


def test_the_last_face_fades_after_its_session_closed() -> None:
    poses = poses_of("a")
    poses.remove("a")
    assert poses.faps(0.5)[0] == 1
    assert not poses.faps(2.0).any()


def test_the_caption_counts_the_sessions() -> None:
    poses = poses_of("a", "b", "c")
    poses.switch(-1)
    assert poses.caption(0.0) == "b, 2 of 3 (Tab: the next)"
