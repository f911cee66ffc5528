"""Records live audio from microphones, and from outputs and programs of this machine."""

import contextlib
import json
import queue
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from kouxing.shared.audio.audio_file import AudioSource, raw_audio
from kouxing.shared.audio.phase_cancellation import Samples
from kouxing.shared.audio.raw_format import RawFormat
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError

_LATENCY_MS = 20  # latency of recordings of outputs and programs
_TIMEOUT_S = 5.0  # for an answer of the sound server, and for the next block of a microphone
_NO_SOUND_SERVER = (
    "recording what this machine plays needs PulseAudio or PipeWire, which does not answer; type: "
    "sudo apt install pulseaudio-utils. On macOS or Windows install a loopback device, such as "
    "BlackHole or VB-CABLE, and select it: kouxing speak mic --device BlackHole"
)


@dataclass(frozen=True, slots=True)
class SoundDevice:
    """A source of live audio."""

    kind: str  # mic, monitor (everything that an output plays) or program
    name: str
    target: str = ""  # parec's option for the device; empty for a microphone


def list_sound_devices(report: Callable[[str], None]) -> list[SoundDevice]:
    """Return all devices; call ``report`` with the reason why a kind cannot be listed."""
    devices: list[SoundDevice] = []
    for list_kind in (_microphones, _monitors):
        try:
            devices += list_kind()
        except UserError as error:
            report(str(error))
    return devices


def open_microphone(name: str) -> AudioSource:
    """Read the microphone whose name contains ``name`` until interrupted. Empty: the default one.

    Raises ``UserError`` if the sound library or the microphone is missing. The blocks raise it if
    the microphone stops, for example because it is unplugged.
    """
    sounddevice = _sound_library()
    if name:
        name = _choose(name, _microphones()).name
    recorded: queue.SimpleQueue[Samples | None] = queue.SimpleQueue()  # None: it stopped
    try:
        stream = sounddevice.InputStream(
            device=name or None,
            samplerate=MEDIA_RATE_HZ,
            channels=1,
            dtype="float32",
            blocksize=MEDIA_RATE_HZ // 50,
            callback=lambda data, *_: recorded.put(data.copy()),
            finished_callback=lambda: recorded.put(None),
        )
    except (sounddevice.PortAudioError, ValueError) as error:
        raise UserError(
            f"cannot open the microphone: {error}; choose one of 'kouxing devices'"
        ) from None

    def blocks() -> Iterator[Samples]:
        try:
            with contextlib.suppress(queue.Empty), stream:
                while (block := recorded.get(timeout=_TIMEOUT_S)) is not None:
                    yield block
        except sounddevice.PortAudioError as error:
            raise UserError(f"cannot record from the microphone: {error}") from None
        raise UserError(
            "the microphone stopped sending audio; reconnect it, and run the command again"
        )

    return AudioSource(name or "microphone", MEDIA_RATE_HZ, 1, None, blocks(), is_live=True)


def open_monitor(name: str = "") -> AudioSource:
    """Record what this machine plays until interrupted, or until the recorded program ends.

    ``name`` is a part of the name of an output or a program; empty: the default output.

    Raises ``UserError`` if the sound server, the output or the program is missing.
    """
    devices = _monitors()
    device = _choose(name, devices) if name else None
    target = device.target if device else "--device=@DEFAULT_MONITOR@"
    command = ["parec", target, "--client-name=kouxing", f"--latency-msec={_LATENCY_MS}"]
    command += ["--format=s16le", f"--rate={MEDIA_RATE_HZ}", "--channels=1"]
    if shutil.which(command[0]) is None:
        raise UserError(_NO_SOUND_SERVER)

    def blocks() -> Iterator[Samples]:
        with (
            tempfile.TemporaryFile() as errors,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors) as parec,  # noqa: S603 - no shell
        ):
            try:
                has_audio = False
                for block in raw_audio(parec.stdout, RawFormat(MEDIA_RATE_HZ), "monitor").blocks:  # type: ignore[arg-type]
                    has_audio = True
                    yield block
                if not has_audio:
                    errors.seek(0)
                    raise UserError(f"cannot record: {errors.read().decode().strip()}")
            finally:
                parec.terminate()

    return AudioSource(
        device.name if device else "monitor", MEDIA_RATE_HZ, 1, None, blocks(), is_live=True
    )


def _sound_library() -> ModuleType:
    try:
        import sounddevice  # noqa: PLC0415 - fails to import without PortAudio
    except OSError:
        raise UserError(
            "the microphone needs the PortAudio library: sudo apt install libportaudio2"
        ) from None
    return sounddevice  # type: ignore[no-any-return] # it is untyped


def _microphones() -> list[SoundDevice]:
    devices = _sound_library().query_devices()
    return [
        SoundDevice("mic", device["name"]) for device in devices if device["max_input_channels"]
    ]


def _monitors() -> list[SoundDevice]:
    """Return the sound server's outputs and the programs that play audio now."""
    outputs = [
        SoundDevice("monitor", source["description"], f"--device={source['name']}")
        for source in _list_from_sound_server("sources")
        if source["properties"].get("device.class") == "monitor"
    ]
    programs = [
        SoundDevice(
            "program",
            playing["properties"].get("application.name", "unnamed"),
            f"--monitor-stream={playing['index']}",
        )
        for playing in _list_from_sound_server("sink-inputs")
    ]
    return outputs + programs


def _list_from_sound_server(kind: str) -> list[dict[str, Any]]:
    try:
        command = ["pactl", "--format=json", "list", kind]
        answer = subprocess.run(command, capture_output=True, check=True, timeout=_TIMEOUT_S)  # noqa: S603 - no shell
        entries: list[dict[str, Any]] = json.loads(answer.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        raise UserError(_NO_SOUND_SERVER) from None
    return entries


def _choose(name: str, devices: list[SoundDevice]) -> SoundDevice:
    """Return the first device whose name contains a text, ignoring case."""
    for device in devices:
        if name.lower() in device.name.lower():
            return device
    names = ", ".join(repr(device.name) for device in devices) or "nothing"
    raise UserError(f"no device is named {name!r}; this machine has {names}")
