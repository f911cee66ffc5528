"""Settings that change what a running system does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kouxing_client import Client, KouxingError

from tests.e2e.following import samples_of_file, stream
from tests.system import CHAIN, VOWELS_FILE, System

SETTINGS = {
    "KOUXING_SYNTHESIZER_FRAME_RATE_HZ": "30",
    "KOUXING_SYNTHESIZER_DELAY_MS": "0",
    "KOUXING_SYNTHESIZER_IDLE_MOTION_SEED": "0",
    "KOUXING_CONTROL_IDLE_LIMIT_S": "1",
}


def test_settings_change_the_frames_and_the_time_limit_of_sessions(tmp_path: Path) -> None:
    with System(CHAIN, tmp_path, SETTINGS) as system, Client(system.control) as client:
        idle = client.open_session(encoding="f32le")
        events = idle.events()
        sent = stream(system.control, samples_of_file(VOWELS_FILE))
        (event,) = (event for event in events.available(60.0) if event.detail)
        with pytest.raises(KouxingError, match=r"control has closed the session: .*no audio"):
            list(idle.frames())
    assert (event.name, "no audio" in event.detail) == ("session-closed", True)
    np.testing.assert_allclose(np.diff(np.array(sent.times) / 16000), 1 / 30, atol=1e-4)
    assert np.abs(sent.faps[:, 2]).max() > 100
    assert np.abs(sent.faps[:, 18:42]).max() == 0, "no idle motion"
    assert np.abs(sent.faps[:, 47:50]).max() == 0
