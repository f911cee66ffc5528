"""Microphones, and what this machine plays: sound that comes in real time, without end."""

from __future__ import annotations

import json
import queue
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from kouxing.shared.audio_file import AudioSource, Samples, raw_audio
from kouxing.shared.errors import UserError

_RATE_HZ = 16_000
_LATENCY_MS = 20  # of what is recorded of other programs
_ANSWER_LIMIT_S = 5.0  # of the sound server
_NO_SOUND_SERVER = (
    "what this machine plays is recorded by PulseAudio or PipeWire, which does not answer; type: "
    "sudo apt install pulseaudio-utils. Elsewhere install a loopback device, such as BlackHole "
    "(macOS) or VB-CABLE (Windows), and name it: kouxing speak mic --device BlackHole"
)


@dataclass(frozen=True, slots=True)
class SoundDevice:
    """Something whose sound can be spoken."""

    kind: str  # mic, monitor (all that an output plays) or program (what one program plays)
    name: str
    target: str = ""  # how the sound server calls it, if it is no microphone


def sound_devices() -> list[SoundDevice]:
    """Return all devices; those that cannot be asked for are left out."""
    devices: list[SoundDevice] = []
    for list_kind in (_microphones, _monitors):
        try:
            devices += list_kind()
        except UserError:
            continue
    return devices


def microphone(name: str = "") -> AudioSource:
    """Read a microphone until interrupted: the default one, or whose name has this part.

    Raises
    ------
    UserError
        If the system has no sound library, no microphone or none of that name.
    """
    sounddevice = _sound_library()
    if name:
        name = _choose(name, _microphones()).name
    recorded: queue.SimpleQueue[Samples] = queue.SimpleQueue()
    try:
        stream = sounddevice.InputStream(
            device=name or None,
            samplerate=_RATE_HZ,
            channels=1,
            dtype="float32",
            blocksize=_RATE_HZ // 50,
            callback=lambda data, *_: recorded.put(data.copy()),
        )
    except (sounddevice.PortAudioError, ValueError) as error:
        raise UserError(f"no microphone can be opened: {error}") from None

    def blocks() -> Iterator[Samples]:
        with stream:
            while True:
                yield recorded.get()

    return AudioSource(name or "microphone", _RATE_HZ, 1, None, blocks(), is_live=True)


def monitor(name: str = "") -> AudioSource:
    """Read what this machine plays until interrupted, or until the program that plays it ends.

    Parameters
    ----------
    name
        Part of the name of an output or of a program; empty: the default output.

    Raises
    ------
    UserError
        If there is no sound server, or nothing of that name.
    """
    devices = _monitors()
    device = _choose(name, devices) if name else None
    target = device.target if device else "--device=@DEFAULT_MONITOR@"
    command = ["parec", target, "--client-name=kouxing", f"--latency-msec={_LATENCY_MS}"]
    command += ["--format=s16le", f"--rate={_RATE_HZ}", "--channels=1"]
    if shutil.which(command[0]) is None:
        raise UserError(_NO_SOUND_SERVER)

    def blocks() -> Iterator[Samples]:
        with (
            tempfile.TemporaryFile() as told,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=told) as parec,  # noqa: S603 - no shell
        ):
            try:
                has_come = False
                for block in raw_audio(parec.stdout, _RATE_HZ, 1).blocks:  # type: ignore[arg-type]
                    has_come = True
                    yield block
                if not has_come:
                    told.seek(0)
                    raise UserError(f"nothing can be recorded: {told.read().decode().strip()}")
            finally:
                parec.terminate()

    return AudioSource(
        device.name if device else "monitor", _RATE_HZ, 1, None, blocks(), is_live=True
    )


def _sound_library() -> ModuleType:
    try:
        import sounddevice  # noqa: PLC0415 - fails to import where PortAudio is missing
    except OSError:
        raise UserError(
            "the microphone needs the PortAudio library; type: sudo apt install libportaudio2"
        ) from None
    return sounddevice  # type: ignore[no-any-return] # it is untyped


def _microphones() -> list[SoundDevice]:
    inputs = (each for each in _sound_library().query_devices() if each["max_input_channels"])
    return [SoundDevice("mic", each["name"]) for each in inputs]


def _monitors() -> list[SoundDevice]:
    """Ask the sound server for its outputs, and for the programs that play something now.

    Raises
    ------
    UserError
        If there is none.
    """
    outputs = [
        SoundDevice("monitor", source["description"], f"--device={source['name']}")
        for source in _ask_sound_server("sources")
        if source["properties"].get("device.class") == "monitor"
    ]
    programs = [
        SoundDevice("program", _program(playing), f"--monitor-stream={playing['index']}")
        for playing in _ask_sound_server("sink-inputs")
    ]
    return outputs + programs


def _program(playing: dict[str, Any]) -> str:
    name: str = playing["properties"].get("application.name", "unnamed")
    return name


def _ask_sound_server(what: str) -> list[dict[str, Any]]:
    try:
        command = ["pactl", "--format=json", "list", what]
        answer = subprocess.run(command, capture_output=True, check=True, timeout=_ANSWER_LIMIT_S)  # noqa: S603 - no shell
        found: list[dict[str, Any]] = json.loads(answer.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        raise UserError(_NO_SOUND_SERVER) from None
    return found


def _choose(name: str, devices: list[SoundDevice]) -> SoundDevice:
    """Return the first device whose name has a part, in any case."""
    for device in devices:
        if name.lower() in device.name.lower():
            return device
    names = ", ".join(repr(device.name) for device in devices) or "none at all"
    raise UserError(f"no device is called {name!r}; there are {names}")
