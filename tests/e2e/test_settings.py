"""Settings that change what a running system does."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from kouxing_client import Client, KouxingError

from tests.e2e.following import samples_of_file, stream
from tests.system import VOWELS_FILE, System

pytestmark = pytest.mark.e2e
SETTINGS = {
    "KOUXING_SYNTHESIZER_FRAME_RATE_HZ": "30",
    "KOUXING_SYNTHESIZER_DELAY_MS": "0",
    "KOUXING_SYNTHESIZER_IDLE_MOTION_SEED": "0",
    "KOUXING_CONTROL_IDLE_LIMIT_S": "1",
    "KOUXING_CONTROL_MAX_SESSIONS": "3",
}


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    services = ("control", "recognizer", "synthesizer")
    with System(services, tmp_path_factory.mktemp("tuned"), settings=SETTINGS) as running:
        yield running


def test_the_frame_rate_is_the_one_that_was_set(tuned: System) -> None:
    heard = stream(tuned.control, samples_of_file(VOWELS_FILE))
    times_s = np.array([frame.media_time for frame in heard.frames]) / 16000
    np.testing.assert_allclose(np.diff(times_s), 1 / 30, atol=1e-4)


def test_without_gestures_the_mouth_alone_moves(tuned: System) -> None:
    heard = stream(tuned.control, samples_of_file(VOWELS_FILE))
    assert np.abs(heard.faps[:, 2]).max() > 100
    assert np.abs(heard.faps[:, 18:42]).max() == 0
    assert np.abs(heard.faps[:, 47:50]).max() == 0


def test_a_session_without_audio_is_closed_and_its_client_told(tuned: System) -> None:
    with Client(tuned.control) as client:
        session = client.open_session(encoding="f32le")
        (event,) = (event for event in session.events().available(60.0) if event.detail)
        assert event.name == "session-closed"
        assert "no audio" in event.detail
        frames = session.frames()
        with pytest.raises(KouxingError, match=r"control has closed the session: .*no audio"):
            list(frames)
