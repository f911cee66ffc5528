"""The gateway decodes the files of the page's *File* button."""

import asyncio
import io
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from urllib.parse import unquote

import aiohttp
import numpy as np
import pytest
import soundfile
from aiohttp import web

from kouxing.services.gateway import sound_upload
from kouxing.services.gateway.access import AccessPolicy
from kouxing.services.gateway.http import make_application
from kouxing.services.gateway.sound_upload import REMARKS_HEADER, SoundUpload
from tests.process.web_clients import async_test

Post = Callable[[str, bytes], Awaitable[tuple[int, bytes, str]]]
SINE = 0.5 * np.sin(np.arange(32_000) * 0.1)


@asynccontextmanager
async def serve() -> AsyncIterator[Post]:
    route = web.post("/sound", SoundUpload().serve)
    runner = web.AppRunner(make_application(head_file="", routes=[route], access=AccessPolicy()))
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    address = f"http://127.0.0.1:{runner.addresses[0][1]}/sound"
    async with aiohttp.ClientSession() as http, asyncio.timeout(100):

        async def post(name: str, data: bytes) -> tuple[int, bytes, str]:
            async with http.post(address, params={"name": name}, data=io.BytesIO(data)) as answer:
                remarks = unquote(answer.headers.get(REMARKS_HEADER, ""))
                return answer.status, await answer.read(), remarks

        yield post
    await runner.cleanup()


def written(suffix: str, channels: np.ndarray) -> bytes:
    file = io.BytesIO()
    soundfile.write(file, channels, 16_000, format=suffix)
    return file.getvalue()


@async_test
async def test_answers_a_file_with_its_sound() -> None:
    six = np.zeros((len(SINE), 6))
    six[:, 2] = SINE  # which browsers would mix into another sound than FFmpeg
    async with serve() as post:
        status, data, remarks = await post("a film.flac", written("FLAC", six))
    assert (status, remarks) == (200, "")
    samples, rate_hz = soundfile.read(io.BytesIO(data))
    assert rate_hz == 16_000
    np.testing.assert_allclose(samples, 0.707 * SINE, atol=1e-3)


@async_test
async def test_a_file_cannot_name_itself_like_a_module_or_a_path() -> None:
    async with serve() as post:
        for name in ("wave.py", "../../x", "-", "口型.wav"):
            status, _, remarks = await post(name, written("WAV", SINE)[:40_000])
            assert status == 200
            assert "the file is cut off after 1.2 s of 2.0 s" in remarks
            assert "/" not in remarks.partition(":")[0]


@async_test
async def test_answers_errors_as_the_commands_do(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serve() as post:
        status, data, _ = await post("a.mp3", b'{"error": "no key"}')
        assert status == 422
        assert b"a.mp3: cannot read audio: this is text, not sound" in data
        monkeypatch.setattr(sound_upload, "MAX_BYTES", 1000)
        status, data, _ = await post("a.wav", written("WAV", SINE))
        assert status == 413
        assert b"larger than" in data
