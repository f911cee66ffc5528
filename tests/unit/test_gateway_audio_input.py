"""Client audio: format checks, and playback in real time."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, cast

import numpy as np
import pytest
from aiohttp import WSMessage, WSMsgType

from kouxing.services.gateway.audio.audio_input import MAX_QUEUED_BYTES, AudioInput
from kouxing.services.gateway.messages.pcm_format import PcmFormat, check_text
from kouxing.services.gateway.web.limits import RealTimeLimit
from kouxing.shared.errors import UserError
from tests.fake_time import with_fake_time

PCM16 = PcmFormat(sample_rate_hz=16000)
FLOAT = PcmFormat(sample_rate_hz=16000, encoding="f32le")
VOICE = 0.1 * np.exp(-(np.arange(32000) % 130) / 30) * np.sin(np.arange(32000) % 130 * 0.3)


class FakeSession:
    """Collects the audio that it receives."""

    def __init__(self, frame_bytes: int, idle_limit_s: float) -> None:
        self.idle_limit_s = idle_limit_s
        self.pcm = bytearray()
        self.num_flushes = 0
        self._frame_bytes = frame_bytes

    def send(self, pcm: bytes, num_samples: int) -> None:
        assert len(pcm) == self._frame_bytes * num_samples
        self.pcm += pcm

    def skip(self, num_samples: int) -> None:
        self.pcm += b"gap" * num_samples

    async def flush(self) -> None:
        self.num_flushes += 1


@asynccontextmanager
async def audio_input(
    pcm_format: PcmFormat = PCM16, *, is_synthesized: bool = True, idle_limit_s: float = 60.0
) -> AsyncIterator[tuple[AudioInput, FakeSession]]:
    """Run an input of a session."""
    session = FakeSession(pcm_format.frame_bytes, idle_limit_s)
    new_input = AudioInput(cast(Any, session), pcm_format, is_synthesized=is_synthesized)
    async with new_input.running():
        yield new_input, session


async def push_all(audio: AudioInput, pcm: bytes, chunk: int) -> None:
    for begin in range(0, len(pcm), chunk):
        await audio.push(pcm[begin : begin + chunk])


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
@with_fake_time
async def test_rejects_audio_of_another_format(
    pcm_format: PcmFormat, pcm: bytes, error: str
) -> None:
    for chunk in (len(pcm), 3 if "JSON" not in error else len(pcm)):
        async with audio_input(pcm_format, is_synthesized=False) as (audio, _):
            with pytest.raises(UserError, match=error):  # noqa: PT012 - perhaps at the end
                await push_all(audio, pcm, chunk)
                await audio.end()


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
@with_fake_time
async def test_accepts_pieces_of_any_length(
    pcm_format: PcmFormat, pcm: bytes, chunk: int, *, is_synthesized: bool
) -> None:
    async with audio_input(pcm_format, is_synthesized=is_synthesized) as (audio, session):
        await push_all(audio, pcm, chunk)
        await audio.push(b"\0")  # an incomplete sample at the end is dropped
        await audio.end()
        await asyncio.sleep(5.0)
    assert session.pcm == pcm


def test_rejects_audio_in_text_messages() -> None:
    for text in ("AAAAAQACAAMABAAFAAYABwAIAAkA", "data:audio/wav;base64,UklGRiQAAABXQVZF"):
        with pytest.raises(UserError, match="this text looks like base64"):
            check_text(text)
    check_text('{"last" : 1}')


@pytest.mark.parametrize(("rate_hz", "chunk"), [(8000, 1234), (22050, 2), (48000, 100_000)])
@with_fake_time
async def test_early_audio_is_passed_on_completely_in_real_time(rate_hz: int, chunk: int) -> None:
    pcm = bytes(range(256)) * (rate_hz // 128)  # 1 s
    async with audio_input(PcmFormat(sample_rate_hz=rate_hz)) as (audio, session):
        await push_all(audio, pcm, chunk)
        await asyncio.sleep(0.5)
        assert 0.45 < len(session.pcm) / len(pcm) < 0.6
        await asyncio.sleep(0.6)
        assert session.pcm.rstrip(b"\0") == pcm
        await asyncio.sleep(30.0)
    silence = session.pcm[len(pcm) :]
    assert set(silence) == {0}, "silence keeps a paused stream open"


@with_fake_time
async def test_silence_keeps_a_session_open_at_any_idle_limit() -> None:
    async with audio_input(idle_limit_s=6.0) as (_, session):
        for num_chunks in (1, 2, 3):
            await asyncio.sleep(2.1)
            assert session.pcm == num_chunks * bytes(2 * 640)


@with_fake_time
async def test_push_waits_while_the_queue_is_full_and_a_flush_empties_it() -> None:
    async with audio_input() as (audio, session):
        for num_bytes in (MAX_QUEUED_BYTES, 3 * 16000 * 2):
            await audio.push(bytes(num_bytes))
        assert 2.5 < asyncio.get_running_loop().time() < 3.5
        audio.skip(1)  # a queued gap
        await audio.flush()
        assert session.num_flushes == 1
        num_before = len(session.pcm)
        assert num_before < 4 * 16000 * 2
        await audio.push(b"\2\0" * 320)
        await asyncio.sleep(1.0)
    assert session.pcm[num_before:] == b"\2\0" * 320


@pytest.mark.parametrize("is_synthesized", [False, True])
@with_fake_time
async def test_skipped_audio_stays_between_the_audio_before_and_after_it(
    *, is_synthesized: bool
) -> None:
    async with audio_input(is_synthesized=is_synthesized) as (audio, session):
        audio.skip(1)
        await audio.push(b"\1\0" * 20_000)
        audio.skip(2)
        audio.skip(1)
        await audio.push(b"\2\0" * 1000)
        audio.skip(4)
        await audio.end()
        await asyncio.sleep(5.0)
    expected = b"gap", b"\1\0" * 20_000, b"gap" * 3, b"\2\0" * 1000, b"gap" * 4
    assert session.pcm == b"".join(expected)


@with_fake_time
async def test_no_task_waits_for_audio_that_a_disconnected_client_left() -> None:
    async with audio_input() as (audio, _):
        await audio.push(bytes(32000))
        await audio.end()
        await asyncio.sleep(0.1)
    await asyncio.sleep(1.0)
    assert asyncio.all_tasks() == {asyncio.current_task()}


@with_fake_time
async def test_the_rate_limit_allows_a_burst_and_then_real_time() -> None:
    limit = RealTimeLimit()
    for _ in range(120):
        await limit.wait(0.05)
    assert asyncio.get_running_loop().time() == pytest.approx(1.0, abs=0.1)


class LiveClient:
    """A WebSocket with half a second of audio and a command every half second."""

    def __init__(self, num_chunks: int, chunk: bytes) -> None:
        self._chunk = chunk
        self._num_chunks = num_chunks
        self._num_received = 0

    async def receive(self) -> WSMessage:
        num_chunks, is_command = divmod(self._num_received, 2)
        if num_chunks == self._num_chunks:
            return WSMessage(WSMsgType.CLOSE, None, None)
        await asyncio.sleep(num_chunks / 2 - asyncio.get_running_loop().time())
        self._num_received += 1
        if is_command:
            return WSMessage(WSMsgType.TEXT, '{"skip": 320}', None)
        return WSMessage(WSMsgType.BINARY, self._chunk, None)


@with_fake_time
async def test_commands_and_a_fast_sound_card_do_not_delay_live_audio() -> None:
    client = LiveClient(2001, bytes(2 * round(0.5 * 16000 * 1.008)))
    async with audio_input(is_synthesized=False) as (audio, _):
        async for message in audio.messages(cast(Any, client)):
            if message.type is WSMsgType.BINARY:
                await audio.push(message.data)
    assert asyncio.get_running_loop().time() == pytest.approx(1000.0, abs=0.1)


class FakeClient:
    """A WebSocket on which no message arrives."""

    is_receiving = False

    async def receive(self) -> None:
        self.is_receiving = True
        try:
            await asyncio.Future()
        finally:
            self.is_receiving = False


@with_fake_time
async def test_a_canceled_reader_no_longer_receives() -> None:
    client = FakeClient()
    async with audio_input(is_synthesized=False) as (audio, _):
        reader = asyncio.ensure_future(anext(audio.messages(cast(Any, client))))
        await asyncio.sleep(0.1)
        assert client.is_receiving
        reader.cancel()
        await asyncio.sleep(0.1)
    assert not client.is_receiving
