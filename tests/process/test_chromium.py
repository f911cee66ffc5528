"""Chromium of the page benches: failures to start, and its microphone."""

import wave
from pathlib import Path

import numpy as np
import pytest

from kouxing.evaluation.system.chromium import Chromium, write_wav
from kouxing.shared.errors import UserError


def test_a_browser_that_cannot_start_gives_its_last_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "chromium"
    program.write_text("#!/bin/sh\necho starting >&2\necho no libnss3.so >&2\nexit 127\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"Chromium did not start: no libnss3\.so"):
        Chromium(tmp_path / "profile", (100, 100), tmp_path / "voice.wav")


def test_the_microphone_clips_loud_audio(tmp_path: Path) -> None:
    write_wav(tmp_path / "voice.wav", np.array([[1.02], [-1.02], [0.5]], np.float32), 16_000)
    with wave.open(str(tmp_path / "voice.wav")) as file:
        samples = np.frombuffer(file.readframes(3), "<i2")
    assert samples.tolist() == [32767, -32768, 16384]
