"""A short recording, and services that need little processor time."""

from pathlib import Path

import pytest
import soundfile

from tests.system import HELLO, LIGHT_MODEL, LIMIT_S, SKIP_NO_AUDIO


@pytest.fixture(autouse=True)
def _light_model(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (LIGHT_MODEL | SKIP_NO_AUDIO).items():
        monkeypatch.setenv(name, value)


@pytest.fixture(autouse=True)
def _longer_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait longer for the first and the last frame on a busy machine."""
    for limit in (
        "kouxing_client.session_core.END_TIMEOUT_S",
        "kouxing.evaluation.system.busy.FIRST_FRAME_LIMIT_S",
        "kouxing.evaluation.system.live.END_TIMEOUT_S",
    ):
        monkeypatch.setattr(limit, LIMIT_S)


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    """A second of speech."""
    path = tmp_path / "speech.wav"
    soundfile.write(path, HELLO[:16_000], 16_000)
    return path
