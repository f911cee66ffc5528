"""Clock offsets, stalls, lateness of frames, hanging services, and the report of lost services."""

import logging
import math

import pytest

from kouxing.services.cli.launch.service_process import POLL_S, HeartbeatGapMeter
from kouxing.services.control.fault_log import FaultLog
from kouxing.services.synthesizer.lateness import LatenessMeter
from kouxing.shared.clock import ClockOffset, StallDetector
from kouxing.shared.monitoring.logs import LOG


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
    stall = StallDetector(now_s=10.0, min_stall_s=0.5)
    assert stall.check(10.4) == 0.0
    assert stall.check(11.3, expected_s=0.5) == 0.0
    assert stall.resumed_at_s == -math.inf
    assert stall.check(12.0) == pytest.approx(0.7)
    assert stall.resumed_at_s == 12.0
    assert stall.elapsed_s(12.2) == pytest.approx(0.2)
    assert stall.elapsed_s(60.0) == 0.5, "without the stall"
    stall.restart(80.0)
    assert stall.check(80.1) == 0.0


@pytest.mark.parametrize("waiting", [0.0, 0.5, 1.0])
def test_time_without_a_processor_does_not_count_as_silence(waiting: float) -> None:
    meter = HeartbeatGapMeter(0.0)
    for number in range(1, 21):
        meter.update(POLL_S * number, waiting * POLL_S * number)
    assert meter.duration_s == pytest.approx((1.0 - waiting) * POLL_S * 20)


@pytest.mark.parametrize(
    ("lasts_s", "level", "is_back_logged"),
    [(0.8, logging.INFO, "recognizer-1 is back after 0.8 s"),
     (2.0, logging.WARNING, "recognizer-1 is back after 2.0 s")],
)  # fmt: skip
def test_only_long_faults_are_reported_with_their_end(
    caplog: pytest.LogCaptureFixture, lasts_s: float, level: int, is_back_logged: str
) -> None:
    faults = FaultLog()
    with caplog.at_level(logging.INFO, LOG.name):
        LOG.addHandler(caplog.handler)
        faults.begin("recognizer-1", "no heartbeat", 10.0)
        for tick in range(1, 20):
            faults.warn(10.0 + min(tick * 0.1, lasts_s))
        faults.end("recognizer-1", 10.0 + lasts_s)
        faults.end("recognizer-1", 20.0)
        LOG.removeHandler(caplog.handler)
    texts = {record.getMessage(): record.levelno for record in caplog.records}
    assert texts == {"lost recognizer-1: no heartbeat": level, is_back_logged: level}


STEP_S = 0.02


class Stream:
    """Frames of live audio that starts at a time of the clock."""

    def __init__(self, now_s: float = 1000.0, speed: float = 1.0) -> None:
        self.meter = LatenessMeter()
        self.now_s = now_s
        self._time_s = 0.0
        self._speed = speed  # of media time

    def run(self, duration_s: float, late_s: float = 0.0) -> None:
        """Send frames that are all late by the same time."""
        for _ in range(round(duration_s / STEP_S)):
            self.now_s += STEP_S
            self._time_s += STEP_S * self._speed
            self.meter.add([self._time_s], self.now_s + late_s)

    def late_ms(self) -> tuple[float, float, float]:
        """Return p50, p95 and the worst lateness, ms."""
        lateness = self.meter.measure(self.now_s)
        assert lateness is not None
        return lateness.p50_ms, lateness.p95_ms, lateness.worst_ms


def test_measures_lateness_relative_to_the_earliest_frame() -> None:
    stream = Stream()
    assert stream.meter.measure(stream.now_s) is None, "no frames"
    stream.run(9.0)
    stream.run(0.9, late_s=0.1)
    stream.run(0.1, late_s=2.0)
    assert stream.late_ms() == pytest.approx((0.0, 100.0, 2000.0), abs=10.0)


def test_only_the_last_ten_seconds_count() -> None:
    stream = Stream()
    stream.run(5.0, late_s=0.5)
    stream.run(11.0)
    assert max(stream.late_ms()) < 1.0
    assert stream.meter.measure(stream.now_s + 20.0) is None


def test_a_growing_delay_stays_visible() -> None:
    stream = Stream(speed=0.7)  # 7 s of frames in 10 s
    stream.run(60.0)
    assert stream.late_ms() == pytest.approx((1500.0, 2850.0, 3000.0), abs=100.0)


@pytest.mark.parametrize("speed", [0.9998, 1.0002])
def test_the_clocks_of_client_and_host_may_differ(speed: float) -> None:
    stream = Stream(speed=speed)
    stream.run(60.0)
    assert max(stream.late_ms()) < 3.0


def test_a_pause_of_the_audio_does_not_count_as_lateness() -> None:
    stream = Stream()
    stream.run(1.0)
    stream.now_s += 5.0
    stream.meter.pause()
    stream.run(1.0)
    assert max(stream.late_ms()) < 1.0
