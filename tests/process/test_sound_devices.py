"""Recordings of what the machine plays, from a scripted sound server, and of a microphone."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kouxing.shared.audio import sound_devices
from kouxing.shared.audio.sound_devices import list_sound_devices, open_microphone, open_monitor
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
    listed = [
        (device.kind, device.name)
        for device in list_sound_devices(lambda _: None)
        if device.kind != "mic"
    ]
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


class _Microphone:
    """Replaces a stream of PortAudio: records one block; ``is_unplugged`` then ends the stream."""

    is_unplugged = True

    def __init__(
        self,
        callback: Callable[..., None],
        finished_callback: Callable[[], None],
        **_settings: object,
    ) -> None:
        self._callback, self._finished_callback = callback, finished_callback

    def __enter__(self) -> None:
        self._callback(np.ones((320, 1), np.float32))
        if self.is_unplugged:
            self._finished_callback()

    def __exit__(self, *_error: object) -> None:
        pass


@pytest.mark.parametrize("is_unplugged", [True, False])
def test_reports_a_microphone_that_stops(
    monkeypatch: pytest.MonkeyPatch, is_unplugged: bool
) -> None:
    library: dict[str, Any] = {"InputStream": _Microphone, "PortAudioError": OSError}
    monkeypatch.setitem(sys.modules, "sounddevice", SimpleNamespace(**library))
    monkeypatch.setattr(_Microphone, "is_unplugged", is_unplugged)
    monkeypatch.setattr(sound_devices, "_TIMEOUT_S", 600.0 if is_unplugged else 0.0)
    blocks = open_microphone("").blocks
    assert len(next(blocks)) == 320
    with pytest.raises(UserError, match="the microphone stopped sending audio; reconnect it"):
        next(blocks)


def test_says_why_microphones_cannot_be_listed(
    monkeypatch: pytest.MonkeyPatch, server: Path
) -> None:
    def fail() -> None:
        raise UserError("no PortAudio")

    monkeypatch.setattr(sound_devices, "_sound_library", fail)
    problems: list[str] = []
    assert [device.name for device in list_sound_devices(problems.append)] == ["HDMI", "Firefox"]
    assert problems == ["no PortAudio"]
