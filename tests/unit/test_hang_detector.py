"""A service hangs if it sends no heartbeats anymore."""

from __future__ import annotations

import pytest

from kouxing.services.cli.service_process import POLL_S, HangDetector

pytestmark = pytest.mark.unit


def hangs_after_s(heartbeats_s: list[float], end_s: float) -> float | None:
    """Return the time at which a service with these heartbeats hangs, up to an end."""
    detector = HangDetector(2.0, 0.0)
    checked_s = 0.0
    for poll in range(1, round(end_s / POLL_S) + 1):
        now_s = poll * POLL_S
        if detector.hangs(any(checked_s < beat_s <= now_s for beat_s in heartbeats_s), now_s):
            return now_s
        checked_s = now_s
    return None


def test_a_service_that_stops_its_heartbeats_hangs() -> None:
    assert hangs_after_s([1.0, 1.3], 10.0) == pytest.approx(1.3 + 2.0, abs=2 * POLL_S)
    assert hangs_after_s([0.9 * number for number in range(100)], 60.0) is None
    assert hangs_after_s([], 60.0) is None, "it still starts"
    detector = HangDetector(2.0, 0.0)
    assert not detector.hangs(True, 0.2)
    assert not detector.hangs(False, 100.0), "the supervisor did not run"
