"""The gateway's learning of a mouth, with other programs in place of the real learning."""

import asyncio
import io
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import pytest
from aiohttp import web

from kouxing.services.gateway.access import AccessPolicy
from kouxing.services.gateway.http import make_application
from kouxing.services.gateway.learn_mouth import MAX_BYTES, MouthLearner
from tests.process.web_clients import async_test

REVERSE = """
import json, sys
json.dump({"mouth_profile": sys.stdin.read()[::-1]}, sys.stdout)
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
time.sleep(60)
"""


class Gateway:
    """A gateway that learns mouths."""

    def __init__(self, learner: MouthLearner, address: str, http: aiohttp.ClientSession) -> None:
        self.learner = learner
        self.address = address
        self.http = http

    async def post(self, recording: bytes = b"abc") -> tuple[int, dict[str, object]]:
        async with self.http.post(self.address, data=io.BytesIO(recording)) as answer:
            return answer.status, await answer.json()


@asynccontextmanager
async def serve(program: str) -> AsyncIterator[Gateway]:
    learner = MouthLearner((sys.executable, "-c", program))
    route = web.post("/learn-mouth", learner.serve)
    runner = web.AppRunner(make_application(head_file="", routes=[route], access=AccessPolicy()))
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    address = f"http://127.0.0.1:{runner.addresses[0][1]}/learn-mouth"
    async with aiohttp.ClientSession() as http, asyncio.timeout(100):
        yield Gateway(learner, address, http)
    await runner.cleanup()


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
    async with serve(REVERSE) as gateway:
        assert await gateway.post() == (200, {"mouth_profile": "cba"})


@pytest.mark.parametrize(
    ("program", "error"),
    [
        (REFUSE, "too little speech; read for 20 s or more"),
        (FAIL, "learning failed; see the gateway's log"),
        (CRASH, "learning failed; see the gateway's log"),
    ],
)
@async_test
async def test_answers_with_the_error(program: str, error: str) -> None:
    async with serve(program) as gateway:
        assert await gateway.post() == (422, {"error": error})
        assert await gateway.post() == (422, {"error": error})  # and accepts the next one


@async_test
async def test_rejects_a_recording_that_is_too_large() -> None:
    async with serve(REVERSE) as gateway:
        status, answer = await gateway.post(bytes(MAX_BYTES + 1))
        assert (status, answer) == (413, {"error": "the recording is larger than 8 MiB"})
        assert (await gateway.post(bytes(MAX_BYTES)))[0] == 200


@async_test
async def test_learns_one_mouth_at_a_time_with_low_priority_and_stops_on_close(
    tmp_path: Path,
) -> None:
    async with serve(HANG) as gateway:
        path = tmp_path / "process"
        first = asyncio.create_task(gateway.post(str(path).encode()))
        process = await process_in(path)
        assert os.getpriority(os.PRIO_PROCESS, process) == 19
        assert gateway.learner.is_running
        status, answer = await gateway.post()
        assert (status, "try again" in str(answer["error"])) == (503, True)
        gateway.learner.close()
        assert await first == (422, {"error": "the gateway is stopping"})
        await wait_until_ended(process)
        assert not gateway.learner.is_running
        assert await gateway.post() == (503, {"error": "the gateway is stopping"})


@async_test
async def test_stops_learning_when_the_browser_disconnects(tmp_path: Path) -> None:
    async with serve(HANG) as gateway:
        path = tmp_path / "process"
        request = asyncio.create_task(gateway.post(str(path).encode()))
        process = await process_in(path)
        request.cancel()
        await wait_until_ended(process)
