"""Uploads of mouths, with other programs in place of the real learning, and of audio files."""

import asyncio
import errno
import io
import json
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import unquote

import aiohttp
import numpy as np
import pytest
import soundfile
from aiohttp import web

from kouxing.services.gateway.uploads import upload_handlers
from kouxing.services.gateway.uploads.upload_handlers import (
    MAX_RECORDING_BYTES,
    REMARKS_HEADER,
    AudioUploadHandler,
    LearnMouthHandler,
    UploadHandler,
)
from kouxing.services.gateway.web.access import AccessPolicy
from kouxing.services.gateway.web.web_application import discard_body, make_application
from tests.process.web_clients import async_test

REVERSE = """
import sys
print(sys.stdin.read()[::-1], end="")
"""
REFUSE = """
import sys
sys.exit(print("too little speech; read for 20 s or more", file=sys.stderr) or 2)
"""
FAIL = "raise RuntimeError('a bug')"
CRASH = "import os; os.abort()"
# writes the process id to the file that the recording names
HANG = """
import os, pathlib, sys, time
pathlib.Path(sys.stdin.read()).write_text(str(os.getpid()))
time.sleep(600)
"""


Answer = tuple[int, bytes, str]  # status, body, warnings
Post = Callable[..., Awaitable[Answer]]
SINE = 0.5 * np.sin(np.arange(32_000) * 0.1)


@asynccontextmanager
async def serve(uploads: UploadHandler) -> AsyncIterator[Post]:
    async with serve_at_port(uploads) as (post, _):
        yield post


@asynccontextmanager
async def serve_at_port(uploads: UploadHandler) -> AsyncIterator[tuple[Post, int]]:
    route = web.post("/upload", uploads.serve)
    runner = web.AppRunner(make_application(head="woman", routes=[route], access=AccessPolicy()))
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    port = runner.addresses[0][1]
    address = f"http://127.0.0.1:{port}/upload"
    async with aiohttp.ClientSession() as http, asyncio.timeout(200):

        async def post(data: bytes | AsyncIterator[bytes] = b"abc", name: str = "") -> Answer:
            body = io.BytesIO(data) if isinstance(data, bytes) else data
            async with http.post(address, params={"name": name}, data=body) as answer:
                warnings = unquote(answer.headers.get(REMARKS_HEADER, ""))
                return answer.status, await answer.read(), warnings

        try:
            yield post, port
        finally:
            await runner.cleanup()


def fake_learner(program: str) -> LearnMouthHandler:
    return LearnMouthHandler((sys.executable, "-c", program))


def error(status: int, text: str) -> Answer:
    return status, json.dumps({"error": text}).encode(), ""


async def process_in(path: Path) -> int:
    """Wait until the learning hangs; return its process id."""
    while not path.is_file() or not path.read_text():
        await asyncio.sleep(0.02)
    return int(path.read_text())


async def wait_until_ended(process: int) -> None:
    while Path(f"/proc/{process}").exists():
        await asyncio.sleep(0.02)


@async_test
async def test_answers_with_the_result_of_the_process() -> None:
    async with serve(fake_learner(REVERSE)) as post:
        assert await post() == (200, b"cba", "")


@pytest.mark.parametrize(
    ("program", "text"),
    [
        (REFUSE, "too little speech; read for 20 s or more"),
        (FAIL, "learning failed; see the gateway's log"),
        (CRASH, "learning failed; see the gateway's log"),
    ],
)
@async_test
async def test_answers_with_the_error_of_the_learner(program: str, text: str) -> None:
    async with serve(fake_learner(program)) as post:
        assert await post() == error(422, text)
        assert await post() == error(422, text)  # and accepts the next one


@async_test
async def test_learning_that_takes_too_long_can_be_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(upload_handlers, "LEARNING_TIMEOUT_S", 0.0)
    async with serve(fake_learner(HANG)) as post:
        text = "learning took longer than 0 s; try again later"
        assert await post(str(tmp_path / "process").encode()) == error(503, text)


@async_test
async def test_a_recording_that_is_too_large_is_rejected() -> None:
    async with serve(fake_learner(REVERSE)) as post:
        assert await post(bytes(MAX_RECORDING_BYTES + 1)) == error(
            413, "the recording is larger than 8 MiB"
        )
        assert (await post(bytes(MAX_RECORDING_BYTES)))[0] == 200


@async_test
async def test_learns_one_mouth_at_a_time_with_low_priority_and_stops_on_close(
    tmp_path: Path,
) -> None:
    hanging = fake_learner(HANG)
    async with serve(hanging) as post:
        path = tmp_path / "process"
        first = asyncio.ensure_future(post(str(path).encode()))
        process = await process_in(path)
        assert os.getpriority(os.PRIO_PROCESS, process) == 19
        assert hanging.is_running
        assert await post() == error(503, LearnMouthHandler.busy_text)
        hanging.close()
        assert await first == error(503, "the gateway is stopping")
        await wait_until_ended(process)
        assert not hanging.is_running
        assert await post() == error(503, "the gateway is stopping")


@async_test
async def test_does_not_learn_from_a_recording_that_arrives_after_close(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hanging, is_receiving = fake_learner(HANG), asyncio.Event()
    receive = hanging.answer

    async def answer(request: web.Request) -> web.StreamResponse:
        is_receiving.set()
        return await receive(request)

    monkeypatch.setattr(hanging, "answer", answer)

    async def record() -> AsyncIterator[bytes]:
        yield str(tmp_path / "process").encode()
        await is_receiving.wait()
        hanging.close()

    async with serve(hanging) as post:
        assert await post(record()) == error(503, "the gateway is stopping")
        assert not hanging.is_running


@async_test
async def test_stops_learning_when_the_browser_disconnects(tmp_path: Path) -> None:
    async with serve(fake_learner(HANG)) as post:
        path = tmp_path / "process"
        request = asyncio.ensure_future(post(str(path).encode()))
        process = await process_in(path)
        request.cancel()
        await wait_until_ended(process)


# --- audio files


def media_bytes(suffix: str, channels: np.ndarray) -> bytes:
    file = io.BytesIO()
    soundfile.write(file, channels, 16_000, format=suffix)
    return file.getvalue()


@async_test
async def test_answers_a_file_with_its_sound() -> None:
    six = np.zeros((len(SINE), 6))
    six[:, 2] = SINE  # which browsers would mix into another sound than FFmpeg
    async with serve(AudioUploadHandler()) as post:
        status, data, warnings = await post(media_bytes("FLAC", six), "a film.flac")
    assert (status, warnings) == (200, "")
    samples, rate_hz = soundfile.read(io.BytesIO(data))
    assert rate_hz == 16_000
    np.testing.assert_allclose(samples, 0.707 * SINE, atol=1e-3)


@async_test
async def test_a_file_cannot_name_itself_like_a_module_or_a_path() -> None:
    async with serve(AudioUploadHandler()) as post:
        for name in ("wave.py", "../../x", "-", "口型.wav"):
            status, _, warnings = await post(media_bytes("WAV", SINE)[:40_000], name)
            assert status == 200
            assert "the file is cut off after 1.2 s of 2.0 s" in warnings
            assert "/" not in warnings.partition(":")[0]


@async_test
async def test_answers_errors_as_the_commands_do(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serve(AudioUploadHandler()) as post:
        status, data, _ = await post(b'{"error": "no key"}', "a.mp3")
        assert status == 422
        assert b"a.mp3: cannot read audio: this is text, not audio" in data
        monkeypatch.setattr(upload_handlers, "MAX_AUDIO_BYTES", 1000)
        status, data, _ = await post(media_bytes("WAV", SINE), "a.wav")
        assert status == 413
        assert b"larger than" in data


@async_test
async def test_a_full_disk_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    text = (
        "the gateway cannot store the file: the disk is full; free space in its temporary folder,"
        " or set TMPDIR to another folder and restart the gateway"
    )
    with Path("/dev/full").open("wb", buffering=0) as full:
        async with serve(AudioUploadHandler()) as post:
            monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: full)
            assert await post(media_bytes("WAV", SINE), "a.wav") == error(422, text)
    monkeypatch.setattr(upload_handlers, "_store", Mock(side_effect=OSError(errno.ENOSPC, "")))
    async with serve(AudioUploadHandler()) as post:
        assert await post(media_bytes("WAV", SINE), "a.wav") == error(422, text)


@pytest.mark.parametrize(
    ("limit", "text"),
    [
        (
            "UPLOAD_TIMEOUT_S",
            "the file did not arrive within 0 s; use a smaller file or a faster connection",
        ),
        ("DECODING_TIMEOUT_S", "reading the file took too long; use a shorter file"),
    ],
)
@async_test
async def test_a_slow_upload_differs_from_slow_decoding(
    monkeypatch: pytest.MonkeyPatch, limit: str, text: str
) -> None:
    monkeypatch.setattr(upload_handlers, limit, 0.0)
    is_discarded = asyncio.Event()

    async def body() -> AsyncIterator[bytes]:
        yield b"a"
        if limit == "UPLOAD_TIMEOUT_S":
            await is_discarded.wait()

    async def discard(request: web.Request) -> None:
        is_discarded.set()
        await discard_body(request)

    monkeypatch.setattr(upload_handlers, "discard_body", discard)
    async with serve(AudioUploadHandler()) as post:
        assert await post(body(), "a.wav") == error(408, text)


@async_test
async def test_a_client_that_does_not_read_its_sound_does_not_block_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    handler = AudioUploadHandler()
    long = media_bytes("FLAC", np.tile(SINE, 300))  # its WAV exceeds the buffers of a connection
    async with serve_at_port(handler) as (post, port):
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1000)
        head = f"POST /upload HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(long)}\r\n\r\n"
        writer.write(head.encode() + long)
        assert b" 200 " in await reader.readline()
        assert (await post(media_bytes("WAV", SINE), "a.wav"))[0] == 200
        monkeypatch.setattr(upload_handlers, "MAX_UNREAD_SOUNDS", 1)
        assert await post(b"abc") == error(503, AudioUploadHandler.busy_text)
        writer.transport.abort()
        while (await post(media_bytes("WAV", SINE), "a.wav"))[0] != 200:
            await asyncio.sleep(0.02)
