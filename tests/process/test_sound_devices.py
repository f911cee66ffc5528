"""Recordings of what the machine plays, from a scripted sound server."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from kouxing.shared.audio.sound_devices import list_sound_devices, open_monitor
from kouxing.shared.errors import UserError

SOURCES = [
    {"name": "mic0", "description": "A microphone", "properties": {"device.class": "sound"}},
    {"name": "hdmi.monitor", "description": "HDMI", "properties": {"device.class": "monitor"}},
]
PLAYING_PROGRAMS = [{"index": 7, "properties": {"application.name": "Firefox"}}]
PCM = np.full(1000, 1 << 14, "<i2").tobytes()


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install programs that replace a sound server's and record their arguments."""
    (tmp_path / "sources").write_text(json.dumps(SOURCES))
    (tmp_path / "sink-inputs").write_text(json.dumps(PLAYING_PROGRAMS))
    (tmp_path / "pcm").write_bytes(PCM)
    for name, line in (
        ("pactl", f'cat "{tmp_path}/$3"'),
        ("parec", f'echo "$@" > {tmp_path}/arguments; cat {tmp_path}/pcm'),
    ):
        (tmp_path / name).write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return tmp_path


def test_rejects_an_unknown_name_and_lists_the_devices(server: Path) -> None:
    listed = [(device.kind, device.name) for device in list_sound_devices() if device.kind != "mic"]
    assert listed == [("monitor", "HDMI"), ("program", "Firefox")]
    error = "no device is named 'vlc'; this machine has 'HDMI', 'Firefox'"
    with pytest.raises(UserError, match=error):
        open_monitor("vlc")


def test_reports_a_missing_sound_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    for name in ("", "firefox"):
        with pytest.raises(UserError, match=r"PulseAudio or PipeWire.*BlackHole"):
            open_monitor(name)


def test_reports_why_it_cannot_record(server: Path) -> None:
    (server / "parec").write_text("#!/bin/sh\necho Connection refused >&2; exit 1\n")
    with pytest.raises(UserError, match="cannot record: Connection refused"):
        next(open_monitor().blocks)
