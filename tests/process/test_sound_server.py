"""Recordings of what a machine plays, from a real PulseAudio without a loudspeaker."""

import itertools
import subprocess
from collections.abc import Generator, Iterator

import numpy as np
import pytest

from kouxing.shared.audio.sound_devices import list_sound_devices, open_monitor
from tests.sound_server import sound_server
from tests.system import LIMIT_S, wait_until

RATE_HZ, TONE_HZ = 16_000, 1000
TONE_S = 600  # longer than the tests take on a busy machine
MAX_BLOCKS = 3000  # 60 s: playback without a loudspeaker may start late
PLAYER = (
    *"pacat --client-name=Player --format=s16le --channels=1 --latency-msec=50".split(),
    f"--rate={RATE_HZ}",
)


@pytest.fixture(scope="module", autouse=True)
def _server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Start a sound server and a program that plays a tone."""
    folder = tmp_path_factory.mktemp("sound")
    tone = 16384 * np.sin(2 * np.pi * TONE_HZ / RATE_HZ * np.arange(TONE_S * RATE_HZ))
    (folder / "tone").write_bytes(tone.astype("<i2").tobytes())
    with sound_server(folder), (folder / "tone").open("rb") as sound:
        player = subprocess.Popen(PLAYER, stdin=sound, stderr=subprocess.DEVNULL)
        wait_until(lambda: len(programs()) == 1)
        yield
        player.terminate()
        player.wait(LIMIT_S)


def programs() -> list[str]:
    return [
        device.name for device in list_sound_devices(lambda _: None) if device.kind == "program"
    ]


def num_recordings() -> int:
    return len(subprocess.check_output("pactl list short source-outputs".split()).splitlines())


@pytest.mark.parametrize("name", ["", "player"])
def test_a_recording_continues_until_the_reader_stops(name: str) -> None:
    blocks = open_monitor(name).blocks
    assert num_recordings() == 0
    num_tones = 0
    for block in itertools.islice(blocks, MAX_BLOCKS):
        peak_hz = np.argmax(np.abs(np.fft.rfft(block[:, 0]))) * RATE_HZ / len(block)
        num_tones += int(abs(peak_hz - TONE_HZ) < 60 and np.abs(block).max() > 0.3)
        if num_tones == 10:
            break
    assert num_tones == 10
    assert isinstance(blocks, Generator)
    blocks.close()
    wait_until(lambda: num_recordings() == 0)


def test_lists_outputs_and_programs() -> None:
    assert [
        device.name for device in list_sound_devices(lambda _: None) if device.kind == "monitor"
    ] == ["Monitor of Loudspeaker"]
    assert programs() == ["Player"]
