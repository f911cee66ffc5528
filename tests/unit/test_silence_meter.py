"""The supervisor restarts a service that hangs, but not one that is only slow."""

import pytest

from kouxing.services.cli.service_process import POLL_S, SilenceMeter


@pytest.mark.parametrize("waiting", [0.0, 0.5, 1.0])
def test_time_without_a_processor_does_not_count_as_silence(waiting: float) -> None:
    meter = SilenceMeter(0.0)
    for number in range(1, 21):
        meter.update(POLL_S * number, waiting * POLL_S * number)
    assert meter.duration_s == pytest.approx((1.0 - waiting) * POLL_S * 20)
