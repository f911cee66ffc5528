"""A short recording, and services that need little processor time."""

from pathlib import Path

import pytest
import soundfile

from tests.system import HELLO, LIGHT_MODEL, SKIP_NO_AUDIO


@pytest.fixture(autouse=True)
def _light_model(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (LIGHT_MODEL | SKIP_NO_AUDIO).items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    """A second of speech."""
    path = tmp_path / "speech.wav"
    soundfile.write(path, HELLO[:16_000], 16_000)
    return path
