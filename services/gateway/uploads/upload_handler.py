"""Handles uploads in a separate process, so that no file can harm or delay the gateway."""

import asyncio
import contextlib
import os
from abc import ABC, abstractmethod
from asyncio import subprocess
from collections.abc import Sequence
from typing import BinaryIO, ClassVar

from aiohttp import web

from kouxing.services.gateway.web.web_application import discard_body
from kouxing.shared.errors import UserError

UPLOAD_TIMEOUT_S = 60.0
PRESENCE_CHECK_S = 0.5  # interval of checks whether the browser is still connected
NICENESS = 19  # lowest priority, so that live streams do not suffer


class UploadHandler(ABC):
    """Handles uploads of one kind, one at a time. Nothing is stored."""

    busy_text: ClassVar[str]  # answer to uploads that arrive during another one

    def __init__(self) -> None:
        self._is_busy = False
        self._is_closing = False
        self._process: subprocess.Process | None = None

    @property
    def is_running(self) -> bool:
        """Whether a process handles an upload."""
        return self._process is not None

    def close(self) -> None:
        """Stop the process, and reject new uploads."""
        self._is_closing = True
        self._kill()

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Answer an upload with its result, or with an error."""
        if self._is_closing:
            return upload_error(503, "the gateway is stopping")
        if self._is_busy:
            await discard_body(request)
            return upload_error(503, self.busy_text)
        self._is_busy = True
        try:
            return await self.answer(request)
        except UserError as error:
            return upload_error(422, str(error))
        finally:
            self._is_busy = False

    @abstractmethod
    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Receive an upload and answer it. A ``UserError`` becomes the answer."""

    async def run(
        self,
        request: web.Request,
        command: Sequence[str],
        timeout_s: float,
        *,
        content: bytes = b"",
        output: BinaryIO | int = subprocess.PIPE,
    ) -> tuple[int, bytes, str]:
        """Run a command; return its exit status, its output and its messages.

        Raises ``TimeoutError`` after ``timeout_s``, and ``UserError`` if the client has left.
        """
        process = self._process = await asyncio.create_subprocess_exec(
            *command,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C in the terminal must reach only the gateway
        )
        with contextlib.suppress(ProcessLookupError):  # the process has already ended
            os.setpriority(os.PRIO_PROCESS, process.pid, NICENESS)
        exchange = asyncio.create_task(process.communicate(content))
        end_s = asyncio.get_running_loop().time() + timeout_s
        try:
            while not exchange.done() and not self._is_closing:
                await asyncio.wait({exchange}, timeout=PRESENCE_CHECK_S)
                if asyncio.get_running_loop().time() > end_s:
                    raise TimeoutError
                if request.transport is None:
                    raise UserError("the browser has disconnected")
        finally:
            self._kill()
            result, messages = await exchange
            self._process = None
        if self._is_closing:
            raise UserError("the gateway is stopping")
        return process.returncode or 0, result, messages.decode(errors="replace").strip()

    def _kill(self) -> None:
        if self._process is not None and self._process.returncode is None:
            self._process.kill()


def upload_error(status: int, text: str) -> web.Response:
    """Return the answer to an upload that failed."""
    return web.json_response({"error": text}, status=status)
