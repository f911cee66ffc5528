"""Learn my mouth: what a browser's camera saw of a speaker's lips becomes this speaker's voice.

The browser sends a landmark file (``docs/my_mouth.md``), ``kouxing adapt`` learns from it in a
process of its own, and everything is forgotten with the answer.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from aiohttp import web

from kouxing.services.gateway.http import MAX_UPLOAD_BYTES
from kouxing.shared.errors import UserError
from kouxing.shared.logs import LOG

UPLOAD_LIMIT_S = 60.0
LEARNING_LIMIT_S = 180.0
PRESENCE_CHECK_S = 0.5  # a browser that has left is noticed within this
ADAPT = (sys.executable, "-m", "kouxing", "adapt")
_NICENESS = 19  # live sessions come first
_USERS_MISTAKE = 2  # exit status


class MouthLearner:
    """Learns one speaker's mouth at a time.

    Parameters
    ----------
    command
        Program and first arguments of ``kouxing adapt``.
    """

    def __init__(self, command: Sequence[str] = ADAPT) -> None:
        self._command = command
        self._is_busy = False
        self._process: asyncio.subprocess.Process | None = None
        self._is_closing = False

    @property
    def is_learning(self) -> bool:
        """Whether a process is learning."""
        return self._process is not None

    def close(self) -> None:
        """End the learning that is under way, and begin no more."""
        self._is_closing = True
        if self._process is not None:
            _kill(self._process)

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Answer a recording with the voice that was learnt of it, or with what is wrong."""
        if self._is_closing:
            return _error(503, "the gateway stops")
        if self._is_busy:
            return _error(503, "another mouth is being learnt; try again in a minute")
        self._is_busy = True
        try:
            recording = await asyncio.wait_for(request.read(), UPLOAD_LIMIT_S)
            with tempfile.TemporaryDirectory(prefix="kouxing-mouth-") as folder:
                answer = await self._learn(request, recording, Path(folder))
            return web.json_response(answer)
        except web.HTTPRequestEntityTooLarge:
            return _error(413, f"the recording is larger than {MAX_UPLOAD_BYTES >> 20} MiB")
        except TimeoutError:
            return _error(408, f"the recording did not arrive within {UPLOAD_LIMIT_S:g} s")
        except UserError as error:
            return _error(422, str(error))
        finally:
            self._is_busy = False

    async def _learn(
        self, request: web.Request, recording: bytes, folder: Path
    ) -> dict[str, object]:
        source, voice, figures = (folder / name for name in ("me.landmarks", "me.voice", "me.json"))
        await asyncio.to_thread(source.write_bytes, recording)
        status, text = await self._run(request, source, "-o", voice, "--json", figures)
        if self._is_closing:
            raise UserError("the gateway stops")
        if status == _USERS_MISTAKE:
            raise UserError(text.strip().removeprefix("kouxing: ").removeprefix(f"{source}: "))
        if status != 0:
            LOG.error("kouxing adapt failed: %s", text)
            raise UserError("learning failed; the gateway's log says why")
        profile = base64.b64encode(await asyncio.to_thread(voice.read_bytes)).decode()
        return {"voice": profile, **json.loads(figures.read_text(encoding="utf-8"))}

    async def _run(self, request: web.Request, *arguments: object) -> tuple[int | None, str]:
        """Run ``kouxing adapt``; return its exit status and its messages."""
        process = self._process = await asyncio.create_subprocess_exec(
            *self._command,
            *map(str, arguments),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C reaches the gateway alone, which ends it in order
        )
        with contextlib.suppress(ProcessLookupError):
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
        communication = asyncio.create_task(process.communicate())
        loop = asyncio.get_running_loop()
        due_s = loop.time() + LEARNING_LIMIT_S
        try:
            while not communication.done():
                await asyncio.wait({communication}, timeout=PRESENCE_CHECK_S)
                if loop.time() > due_s:
                    raise UserError(f"learning took longer than {LEARNING_LIMIT_S:g} s")
                if request.transport is None:
                    raise UserError("the browser has left")
        finally:
            _kill(process)
            _, text = await communication
            self._process = None
        return process.returncode, text.decode("utf-8", "replace")


def _kill(process: asyncio.subprocess.Process) -> None:
    """End a process and those that it started."""
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def _error(status: int, text: str) -> web.Response:
    return web.json_response({"error": text}, status=status)
