"""Client audio: format checks, and playback in real time."""

import asyncio
import json

import numpy as np
import pytest

from kouxing.services.gateway.audio.audio_input import MAX_QUEUED_BYTES, AudioInput
from kouxing.services.gateway.messages.pcm_format import PcmFormat, check_text
from kouxing.services.gateway.web.limits import RealTimeLimit
from kouxing.shared.errors import UserError
from tests.fake_time import run

PCM16 = PcmFormat(sample_rate_hz=16000)
FLOAT = PcmFormat(sample_rate_hz=16000, encoding="f32le")
VOICE = 0.1 * np.exp(-(np.arange(32000) % 130) / 30) * np.sin(np.arange(32000) % 130 * 0.3)


@pytest.mark.parametrize(
    ("pcm_format", "pcm", "error"),
    [
        (
            PCM16,
            b"RIFF" + bytes(40),
            "s16le.*without a header; this looks like the start of a WAV file",
        ),
        (PCM16, b"\x1aE\xdf\xa3" + bytes(100), "WebM, the format of MediaRecorder"),
        (PCM16, b"\0\0\0\x20ftypM4A " + bytes(20), "an MP4 file"),
        (PCM16, json.dumps({"audio": "AAAA"}).encode(), "this is JSON: send it as a text message"),
        (FLOAT, np.array([0, 12345], "<f4").tobytes(), "between -1 and 1, got 12345"),
        (FLOAT, np.array([0, np.nan], "<f4").tobytes(), "between -1 and 1, got nan"),
        (FLOAT, np.array([5, -5, 900, -900], "<i2").tobytes(), "or set encoding to s16le"),
        (PCM16, VOICE.astype("<f4").tobytes(), "noise, perhaps 32-bit float samples: decode"),
    ],
)
def test_rejects_audio_of_another_format(pcm_format: PcmFormat, pcm: bytes, error: str) -> None:
    async def speak(chunk: int) -> None:
        audio_input = AudioInput(FakeSession(), pcm_format, is_synthesized=False)  # type: ignore[arg-type]
        for begin in range(0, len(pcm), chunk):
            await audio_input.push(pcm[begin : begin + chunk])
        await audio_input.end()

    for chunk in (len(pcm), 3 if "JSON" not in error else len(pcm)):
        with pytest.raises(UserError, match=error):
            run(speak(chunk))


@pytest.mark.parametrize("is_synthesized", [False, True])
@pytest.mark.parametrize("chunk", [1, 999, 10_001])
@pytest.mark.parametrize(
    ("pcm_format", "pcm"),
    [
        (PCM16, b"\0\1RIFF"),
        (FLOAT, np.array([1.5, -1.5] * 900, "<f4").tobytes()),
        (PcmFormat(sample_rate_hz=48000, num_channels=2), bytes(range(250)) * 80),
    ],
)
def test_accepts_pieces_of_any_length(
    pcm_format: PcmFormat, pcm: bytes, chunk: int, *, is_synthesized: bool
) -> None:
    async def speak() -> None:
        session = FakeSession(pcm_format.frame_bytes)
        audio_input = AudioInput(session, pcm_format, is_synthesized=is_synthesized)  # type: ignore[arg-type]
        async with audio_input.running():
            for begin in range(0, len(pcm), chunk):
                await audio_input.push(pcm[begin : begin + chunk])
            await audio_input.push(b"\0")  # an incomplete sample at the end is dropped
            await audio_input.end()
            await asyncio.sleep(5.0)
        assert session.pcm == pcm

    run(speak())


def test_rejects_audio_in_text_messages() -> None:
    for text in ("AAAAAQACAAMABAAFAAYABwAIAAkA", "data:audio/wav;base64,UklGRiQAAABXQVZF"):
        with pytest.raises(UserError, match="this text looks like base64"):
            check_text(text)
    check_text('{"last" : 1}')


class FakeSession:
    """Collects the audio that it receives."""

    idle_limit_s = 60.0

    def __init__(self, frame_bytes: int = 2) -> None:
        self.pcm = b""
        self.num_flushes = 0
        self._frame_bytes = frame_bytes

    def send(self, pcm: bytes, num_samples: int) -> None:
        assert len(pcm) == self._frame_bytes * num_samples
        self.pcm += pcm

    def skip(self, num_samples: int) -> None:
        self.pcm += b"gap" * num_samples

    async def flush(self) -> None:
        self.num_flushes += 1


@pytest.mark.parametrize(("rate_hz", "chunk"), [(8000, 1234), (22050, 2), (48000, 100_000)])
def test_early_audio_is_passed_on_completely_in_real_time(rate_hz: int, chunk: int) -> None:
    pcm = bytes(range(256)) * (rate_hz // 128)  # 1 s

    async def speak() -> None:
        session = FakeSession()
        pcm_format = PcmFormat(sample_rate_hz=rate_hz)
        audio_input = AudioInput(session, pcm_format, is_synthesized=True)  # type: ignore[arg-type]
        async with audio_input.running():
            for begin in range(0, len(pcm), chunk):
                await audio_input.push(pcm[begin : begin + chunk])
            await asyncio.sleep(0.5)
            assert 0.45 < len(session.pcm) / len(pcm) < 0.6
            await asyncio.sleep(0.6)
        assert session.pcm == pcm
        async with audio_input.running():
            await asyncio.sleep(30.0)
        assert set(session.pcm[len(pcm) :]) == {0}, "silence keeps a paused stream open"

    run(speak())


def test_silence_keeps_a_session_open_at_any_idle_limit() -> None:
    async def pause() -> None:
        session = FakeSession()
        session.idle_limit_s = 6.0
        audio_input = AudioInput(session, PCM16, is_synthesized=True)  # type: ignore[arg-type]
        async with audio_input.running():
            for num_chunks in (1, 2, 3):
                await asyncio.sleep(2.1)
                assert session.pcm == num_chunks * bytes(2 * 640)

    run(pause())


def test_push_waits_while_the_queue_is_full_and_a_flush_empties_it() -> None:
    async def speak() -> None:
        session = FakeSession()
        audio_input = AudioInput(session, PCM16, is_synthesized=True)  # type: ignore[arg-type]
        async with audio_input.running():
            for num_bytes in (MAX_QUEUED_BYTES, 3 * 16000 * 2):
                await audio_input.push(bytes(num_bytes))
            assert 2.5 < asyncio.get_running_loop().time() < 3.5
            await audio_input.flush()
            assert session.num_flushes == 1
            num_before = len(session.pcm)
            assert num_before < 4 * 16000 * 2
            await audio_input.push(b"\2\0" * 320)
            await asyncio.sleep(1.0)
        assert session.pcm[num_before:] == b"\2\0" * 320

    run(speak())


@pytest.mark.parametrize("is_synthesized", [False, True])
def test_skipped_audio_stays_between_the_audio_before_and_after_it(*, is_synthesized: bool) -> None:
    async def speak() -> None:
        session = FakeSession()
        audio_input = AudioInput(session, PCM16, is_synthesized=is_synthesized)  # type: ignore[arg-type]
        async with audio_input.running():
            audio_input.skip(1)
            await audio_input.push(b"\1\0" * 20_000)
            audio_input.skip(2)
            audio_input.skip(1)
            await audio_input.push(b"\2\0" * 1000)
            audio_input.skip(4)
            await audio_input.end()
            await asyncio.sleep(5.0)
        expected = b"gap", b"\1\0" * 20_000, b"gap" * 3, b"\2\0" * 1000, b"gap" * 4
        assert session.pcm == b"".join(expected)

    run(speak())


def test_a_flush_also_drops_queued_gaps() -> None:
    async def speak() -> None:
        session = FakeSession()
        audio_input = AudioInput(session, PCM16, is_synthesized=True)  # type: ignore[arg-type]
        async with audio_input.running():
            await audio_input.push(bytes(320))
            audio_input.skip(1)
            await audio_input.flush()
            await audio_input.push(b"\2\0" * 1000)
            await asyncio.sleep(1.0)
        assert session.pcm == b"\2\0" * 1000

    run(speak())


def test_no_task_waits_for_audio_that_a_disconnected_client_left() -> None:
    async def speak() -> None:
        audio_input = AudioInput(FakeSession(), PCM16, is_synthesized=True)  # type: ignore[arg-type]
        async with audio_input.running():
            await audio_input.push(bytes(32000))
            await audio_input.end()
            await asyncio.sleep(0.1)
        await asyncio.sleep(1.0)
        assert asyncio.all_tasks() == {asyncio.current_task()}

    run(speak())


def test_the_rate_limit_allows_a_burst_and_then_real_time() -> None:
    async def flood() -> None:
        limit = RealTimeLimit()
        for _ in range(120):
            await limit.wait(0.05)
        assert asyncio.get_running_loop().time() == pytest.approx(1.0, abs=0.01)

    run(flood())


def test_a_canceled_reader_no_longer_receives() -> None:
    async def cancel_reader() -> bool:
        receiving = asyncio.Event()
        is_receiving = False

        class Client:
            async def receive(self) -> None:
                nonlocal is_receiving
                is_receiving = True
                receiving.set()
                try:
                    await asyncio.Future()
                finally:
                    is_receiving = False

        audio_input = AudioInput(FakeSession(), PCM16, is_synthesized=False)  # type: ignore[arg-type]
        messages = audio_input.messages(Client())  # type: ignore[arg-type]
        reader: asyncio.Future[object] = asyncio.ensure_future(anext(messages))
        await receiving.wait()
        reader.cancel()
        await asyncio.wait({reader})
        await asyncio.sleep(0)  # the task that receives ends
        return is_receiving

    assert not asyncio.run(cancel_reader())
