"""The supervisor restarts a service that hangs, but not one that is only slow."""

from __future__ import annotations

import pytest

from kouxing.services.cli.service_process import POLL_S, SilenceMeter


@pytest.mark.parametrize("waiting", [0.0, 0.5, 1.0])
def test_time_without_a_processor_is_no_silence(waiting: float) -> None:
    meter = SilenceMeter(0.0)
    for number in range(1, 21):
        meter.update(POLL_S * number, waiting * POLL_S * number, is_stopped=False)
    assert meter.duration_s == pytest.approx((1.0 - waiting) * POLL_S * 20)


def test_a_stopped_loop_is_not_silent() -> None:
    meter = SilenceMeter(0.0)
    for number in range(1, 5):
        meter.update(POLL_S * number, 0.0, is_stopped=number > 2)
    assert (meter.duration_s, meter.stopped_s) == (2 * POLL_S, 2 * POLL_S)
