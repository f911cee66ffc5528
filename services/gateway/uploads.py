"""Uploads that a separate process handles, so that no file can harm or delay the gateway."""

import asyncio
import contextlib
import os
from abc import ABC, abstractmethod
from asyncio import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, ClassVar

from aiohttp import web

from kouxing.services.gateway.http import discard_body, error_response
from kouxing.shared.errors import USER_ERROR, UserError
from kouxing.shared.logs import LOG

UPLOAD_LIMIT_S = 60.0
PRESENCE_CHECK_S = 0.5  # interval at which a disconnected browser is noticed
NICENESS = 19  # lowest priority, so that live streams do not suffer
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_STATUSES = {"stopping": 503, "busy": 503, "too-large": 413, "too-slow": 408}  # by error code


class Uploads(ABC):
    """Handles uploads of one kind, one at a time. Nothing is stored."""

    busy_text: ClassVar[str]  # answer to uploads that arrive in the meantime
    slow_text: ClassVar[str]  # answer after a timeout
    failed_text: ClassVar[str]  # answer after a crash of the process
    bad_code: ClassVar[str]  # error code of uploads that cannot be used

    def __init__(self) -> None:
        self._is_busy = False
        self._is_closing = False
        self._process: subprocess.Process | None = None

    @property
    def is_running(self) -> bool:
        """Whether a process handles an upload."""
        return self._process is not None

    def close(self) -> None:
        """Stop the process, and reject further uploads."""
        self._is_closing = True
        self._kill()

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Answer an upload with its result, or with an error."""
        try:
            self._check_open()
            if self._is_busy:
                await discard_body(request)
                raise UserError(self.busy_text, "busy")
            self._is_busy = True
            try:
                return await self.answer(request)
            except TimeoutError:
                raise UserError(self.slow_text, "too-slow") from None
            finally:
                self._is_busy = False
        except UserError as error:
            return error_response(error, self.bad_code, _STATUSES.get(error.code, 422))

    @abstractmethod
    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Receive an upload and answer it. A ``UserError`` or a timeout becomes the answer."""

    async def run(
        self,
        request: web.Request,
        command: Sequence[str],
        limit_s: float,
        *,
        content: bytes = b"",
        output: BinaryIO | int = subprocess.PIPE,
        folder: Path | None = None,
    ) -> tuple[bytes, str]:
        """Run a command in a folder; return its output and its messages.

        Raises ``TimeoutError`` after ``limit_s``, and ``UserError`` if the process reports an error
        or crashes, or nobody waits anymore.
        """
        process = self._process = await asyncio.create_subprocess_exec(
            *command,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
            cwd=folder,
            start_new_session=True,  # Ctrl-C in the terminal must reach only the gateway
        )
        with contextlib.suppress(ProcessLookupError):  # it has ended already
            os.setpriority(os.PRIO_PROCESS, process.pid, NICENESS)
        exchange = asyncio.create_task(process.communicate(content))
        end_s = asyncio.get_running_loop().time() + limit_s
        try:
            while not exchange.done():
                await asyncio.wait({exchange}, timeout=PRESENCE_CHECK_S)
                if asyncio.get_running_loop().time() > end_s:
                    raise TimeoutError
                if request.transport is None:
                    raise UserError("the browser has disconnected")
        finally:
            self._kill()
            result, errors = await exchange
            self._process = None
        self._check_open()
        messages = errors.decode(errors="replace").rstrip()
        if process.returncode == USER_ERROR:
            code, _, text = messages.partition("\t")
            raise UserError(text, code)
        if process.returncode:
            LOG.error("%s failed with status %d: %s", command[-1], process.returncode, messages)
            raise UserError(self.failed_text)
        return result, messages

    def _check_open(self) -> None:
        if self._is_closing:
            raise UserError("the gateway is stopping", "stopping")

    def _kill(self) -> None:
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
