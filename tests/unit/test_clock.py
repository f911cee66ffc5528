import math

import pytest

from kouxing.shared.clock import ClockOffset, StallDetector


def test_the_exchange_with_the_shortest_round_trip_gives_the_offset() -> None:
    clock = ClockOffset()
    assert clock.offset_ms == 0.0
    ahead_ns = 5_000_000
    clock.update(0, 30_000_000 + ahead_ns, 30_000_000 + ahead_ns, 40_000_000)  # 30 out, 10 back
    assert clock.offset_ms == pytest.approx(15.0)
    clock.update(0, 1_000_000 + ahead_ns, 2_000_000 + ahead_ns, 3_000_000)  # 1 out, 1 back
    clock.update(0, 9_000_000 + ahead_ns, 9_000_000 + ahead_ns, 10_000_000)
    assert clock.offset_ms == pytest.approx(5.0)


def test_a_pause_beyond_the_limit_is_a_stall_unless_the_clock_restarts() -> None:
    stall = StallDetector(now_s=10.0, limit_s=0.5)
    assert stall.check(10.4) == 0.0
    assert stall.check(11.3, expected_s=0.5) == 0.0
    assert stall.resumed_at_s == -math.inf
    assert stall.check(12.0) == pytest.approx(0.7)
    assert stall.resumed_at_s == 12.0
    assert stall.elapsed_s(12.2) == pytest.approx(0.2)
    assert stall.elapsed_s(60.0) == 0.5, "without the stall"
    stall.restart(80.0)
    assert stall.check(80.1) == 0.0
