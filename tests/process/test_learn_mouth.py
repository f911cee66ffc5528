"""The gateway's learning of a mouth, with a program in the place of ``kouxing adapt``."""

from __future__ import annotations

import asyncio
import base64
import io
import os
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import pytest
from aiohttp import web

from kouxing.services.gateway import learn_mouth
from kouxing.services.gateway.http import MAX_UPLOAD_BYTES, make_application
from kouxing.services.gateway.learn_mouth import MouthLearner

pytestmark = pytest.mark.process

LEARN = """
import pathlib, sys
source, _, voice, _, figures = sys.argv[1:]
pathlib.Path(voice).write_bytes(pathlib.Path(source).read_bytes()[::-1])
pathlib.Path(figures).write_text('{"before": {"opening": null}, "after": {"opening": 0.5}}')
"""
REFUSE = """
import sys
print(f"kouxing: {sys.argv[1]}: too little speech; read for 20 s or more", file=sys.stderr)
sys.exit(2)
"""
FAIL = "raise RuntimeError('a bug')"
# Tells that it runs, and starts a process of its own, which must end with it.
HANG = """
import pathlib, subprocess, sys
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
pathlib.Path(sys.argv[1]).with_name("child").write_text(str(child.pid))
child.wait()
"""


class Gateway:
    """A page that learns, and the folder in which it does."""

    def __init__(self, learner: MouthLearner, address: str, folder: Path) -> None:
        self.learner = learner
        self.address = address
        self.folder = folder

    async def post(
        self, http: aiohttp.ClientSession, recording: bytes = b"abc"
    ) -> tuple[int, dict[str, object]]:
        async with http.post(self.address, data=io.BytesIO(recording)) as answer:
            return answer.status, await answer.json()

    async def child(self) -> int:
        """Wait until the program hangs; return the process that it has started."""
        while True:
            for path in self.folder.glob("*/child"):
                if text := path.read_text():
                    return int(text)
            await asyncio.sleep(0.02)


@asynccontextmanager
async def serve(script: str) -> AsyncIterator[Gateway]:
    learner = MouthLearner((sys.executable, "-c", script))
    route = web.post("/learn-mouth", learner.serve)
    runner = web.AppRunner(make_application(page_asset="", routes=[route]))
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    port = runner.addresses[0][1]
    folder = Path(tempfile.gettempdir())
    yield Gateway(learner, f"http://127.0.0.1:{port}/learn-mouth", folder)
    await runner.cleanup()
    assert not list(folder.iterdir())


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let temporary folders be made where nobody else makes some."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


Use = Callable[[Gateway, aiohttp.ClientSession], Coroutine[None, None, None]]


def run(script: str, use: Use) -> None:
    async def serve_and_use() -> None:
        async with serve(script) as gateway, aiohttp.ClientSession() as http:
            await asyncio.wait_for(use(gateway, http), 100)

    asyncio.run(serve_and_use())


def is_running(process: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except FileNotFoundError:
        return False


async def until_gone(process: int) -> None:
    while is_running(process):
        await asyncio.sleep(0.02)


def test_the_voice_comes_back_with_its_figures() -> None:
    async def use(gateway: Gateway, http: aiohttp.ClientSession) -> None:
        assert await gateway.post(http) == (
            200,
            {
                "voice": base64.b64encode(b"cba").decode(),
                "before": {"opening": None},
                "after": {"opening": 0.5},
            },
        )

    run(LEARN, use)


@pytest.mark.parametrize(
    ("script", "error"),
    [
        (REFUSE, "too little speech; read for 20 s or more"),
        (FAIL, "learning failed; the gateway's log says why"),
    ],
)
def test_what_is_wrong_is_told_in_words(script: str, error: str) -> None:
    async def use(gateway: Gateway, http: aiohttp.ClientSession) -> None:
        assert await gateway.post(http) == (422, {"error": error})
        assert await gateway.post(http) == (422, {"error": error})  # and the next may try

    run(script, use)


def test_a_recording_that_is_too_large_is_refused() -> None:
    async def use(gateway: Gateway, http: aiohttp.ClientSession) -> None:
        status, answer = await gateway.post(http, bytes(MAX_UPLOAD_BYTES + 1))
        assert (status, answer) == (413, {"error": "the recording is larger than 8 MiB"})
        assert (await gateway.post(http, bytes(MAX_UPLOAD_BYTES)))[0] == 200

    run(LEARN, use)


def test_pages_of_others_are_refused() -> None:
    async def use(gateway: Gateway, http: aiohttp.ClientSession) -> None:
        origin = {"Origin": "http://evil.example"}
        async with http.post(gateway.address, data=b"abc", headers=origin) as answer:
            assert answer.status == 403

    run(LEARN, use)


def test_one_learns_at_a_time_and_stopping_ends_it() -> None:
    async def use(gateway: Gateway, http: aiohttp.ClientSession) -> None:
        first = asyncio.create_task(gateway.post(http))
        child = await gateway.child()
        assert gateway.learner.is_learning
        status, answer = await gateway.post(http)
        assert (status, "try again" in str(answer["error"])) == (503, True)
        gateway.learner.close()
        assert await first == (422, {"error": "the gateway stops"})
        await until_gone(child)
        assert not gateway.learner.is_learning
        assert await gateway.post(http) == (503, {"error": "the gateway stops"})

    run(HANG, use)


def test_learning_ends_when_its_time_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learn_mouth, "LEARNING_LIMIT_S", 0.5)

    async def use(gateway: Gateway, http: aiohttp.ClientSession) -> None:
        first = asyncio.create_task(gateway.post(http))
        assert await first == (422, {"error": "learning took longer than 0.5 s"})

    run(HANG, use)


def test_learning_ends_when_the_browser_leaves() -> None:
    async def use(gateway: Gateway, http: aiohttp.ClientSession) -> None:
        first = asyncio.create_task(gateway.post(http))
        child = await gateway.child()
        first.cancel()
        await until_gone(child)

    run(HANG, use)


def test_learning_leaves_the_processor_to_live_sessions() -> None:
    async def use(gateway: Gateway, http: aiohttp.ClientSession) -> None:
        first = asyncio.create_task(gateway.post(http))
        child = await gateway.child()
        while os.getpriority(os.PRIO_PGRP, os.getpgid(child)) < 19:
            await asyncio.sleep(0.02)
        first.cancel()
        await until_gone(child)

    run(HANG, use)
