"""Lateness of the frames of a live session, with injected time."""

import pytest

from kouxing.services.synthesizer.lateness import LatenessMeter

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
