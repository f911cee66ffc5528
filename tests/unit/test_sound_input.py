"""Sound of clients: what it must be, and how it is kept to real time."""

from __future__ import annotations

import asyncio
import json

import numpy as np
import pytest

from kouxing.services.gateway.sound_format import SoundFormat, check_text
from kouxing.services.gateway.sound_input import SoundInput
from kouxing.shared.errors import UserError

pytestmark = pytest.mark.unit

PCM16 = SoundFormat(sample_rate_hz=16000)
FLOAT = SoundFormat(sample_rate_hz=16000, encoding="f32le")


@pytest.mark.parametrize(
    ("sound", "pcm", "told"),
    [
        (PCM16, bytes(3), "s16le samples, 16000 Hz mono.*multiple of 2 bytes; 3 came"),
        (FLOAT, bytes(6), "multiple of 4 bytes; 6 came"),
        (PCM16, b"RIFF" + bytes(40), "without a header; this begins as a WAV file"),
        (PCM16, b"\x1aE\xdf\xa3" + bytes(100), "WebM, as MediaRecorder makes it"),
        (PCM16, b"\0\0\0\x20ftypM4A " + bytes(20), "an MP4 file"),
        (PCM16, json.dumps({"audio": "AAAA"}).encode(), "this is JSON: send it as a text message"),
        (FLOAT, np.array([0, 12345], "<f4").tobytes(), "between -1 and 1; one is 12345"),
        (FLOAT, np.array([0, np.nan], "<f4").tobytes(), "between -1 and 1; one is nan"),
        (FLOAT, np.array([5, -5, 900, -900], "<i2").tobytes(), "or say encoding s16le"),
    ],
)
def test_sound_of_a_wrong_format_says_what_was_expected(
    sound: SoundFormat, pcm: bytes, told: str
) -> None:
    with pytest.raises(UserError, match=told):
        sound.num_frames(pcm, is_first=True)


def test_what_is_sound_is_taken() -> None:
    assert PCM16.num_frames(b"{}" * 100, is_first=True) == 100
    assert PCM16.num_frames(b"RIFF", is_first=False) == 2
    assert FLOAT.num_frames(np.array([1.5, -1.5], "<f4").tobytes(), is_first=True) == 2
    assert PCM16.num_frames(b"", is_first=True) == 0


def test_text_that_holds_sound_says_what_was_expected() -> None:
    for text in ("AAAAAQACAAMABAAFAAYABwAIAAkA", "data:audio/wav;base64,UklGRiQAAABXQVZF"):
        with pytest.raises(UserError, match="expected pcm; this text looks like base64"):
            check_text(text, "pcm")
    check_text('{"eof" : 1}', "pcm")


class Recorded:
    """Takes the place of a session."""

    def __init__(self) -> None:
        self.pcm = b""
        self.num_flushes = 0

    def send(self, pcm: bytes, num_frames: int) -> None:
        assert len(pcm) == 2 * num_frames
        self.pcm += pcm

    async def flush(self) -> None:
        self.num_flushes += 1


async def wait_for(recorded: Recorded, num_bytes: int) -> None:
    async with asyncio.timeout(60):
        while len(recorded.pcm) < num_bytes:
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("rate_hz", [8000, 16000, 22050, 24000, 44100, 48000])
@pytest.mark.parametrize("chunk", [2, 1234, 100_000])
def test_speech_ahead_of_its_time_goes_on_whole_whatever_its_chunks(
    rate_hz: int, chunk: int
) -> None:
    pcm = bytes(range(256)) * (rate_hz // 2560)  # a twentieth of a second

    async def speak() -> bytes:
        recorded = Recorded()
        sound = SoundFormat(sample_rate_hz=rate_hz)
        queued = SoundInput(recorded, sound, is_ahead=True)  # type: ignore[arg-type]
        async with queued.running():
            for begin in range(0, len(pcm), chunk):
                await queued.accept(pcm[begin : begin + chunk])
            await wait_for(recorded, len(pcm))
        return recorded.pcm

    assert asyncio.run(speak()) == pcm


def test_an_interruption_drops_what_waits_and_the_stream_goes_on() -> None:
    async def speak() -> None:
        recorded = Recorded()
        queued = SoundInput(recorded, PCM16, is_ahead=True)  # type: ignore[arg-type]
        async with queued.running():
            await queued.accept(b"\1\0" * 16000 * 20)
            assert len(recorded.pcm) == 0
            await wait_for(recorded, 1)
            await queued.flush()
            assert recorded.num_flushes == 1
            num_before = len(recorded.pcm)
            assert num_before < 2 * 16000 * 20
            await queued.accept(b"\2\0" * 320)
            await wait_for(recorded, num_before + 640)
        assert recorded.pcm[num_before:] == b"\2\0" * 320

    asyncio.run(speak())


def test_a_stream_that_pauses_stays_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kouxing.services.gateway.sound_input.KEEP_ALIVE_S", 0.02)

    async def speak() -> Recorded:
        recorded = Recorded()
        queued = SoundInput(recorded, PCM16, is_ahead=True)  # type: ignore[arg-type]
        async with queued.running():
            await wait_for(recorded, 1)
        return recorded

    assert set(asyncio.run(speak()).pcm) == {0}
