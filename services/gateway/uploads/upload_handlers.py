"""Handles uploads in separate processes, so that no file can harm or delay the gateway."""

import asyncio
import contextlib
import os
import re
import sys
import tempfile
import weakref
from abc import ABC, abstractmethod
from asyncio import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, ClassVar
from urllib.parse import quote

from aiohttp import web

from kouxing.services.gateway.uploads import audio_decoder
from kouxing.services.gateway.web.web_application import discard_body
from kouxing.services.mouth_profiles import learning_process
from kouxing.shared.errors import USER_ERROR, UserError
from kouxing.shared.monitoring.logs import LOG

UPLOAD_TIMEOUT_S = 60.0
PRESENCE_CHECK_S = 0.5  # interval of checks whether the browser is still connected
NICENESS = 19  # lowest priority, so that live streams do not suffer
MAX_AUDIO_BYTES = 200 << 20
DECODING_TIMEOUT_S = 60.0
MAX_UNREAD_SOUNDS = 4  # decoded files that browsers have not read yet; each has up to 345 MB
MAX_RECORDING_BYTES = 8 << 20
LEARNING_TIMEOUT_S = 180.0
REMARKS_HEADER = "Kouxing-Remarks"
_NOT_IN_NAMES = re.compile(r"[^\w.() -]")
_MAX_NAME_CHARACTERS = 80
_READ_BYTES = 1 << 16


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
            return _upload_error(503, "the gateway is stopping")
        if self._is_busy:
            await discard_body(request)
            return _upload_error(503, self.busy_text)
        self._is_busy = True
        try:
            return await self.answer(request)
        except UserError as error:
            return _upload_error(503 if self._is_closing else 422, str(error))
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


class AudioUploadHandler(UploadHandler):
    """Decodes audio files for the page's *File* button, like the commands.

    The browser sends a file and receives 16-bit WAV, mono.
    """

    busy_text = "another file is being read; try again in a few seconds"

    def __init__(self) -> None:
        super().__init__()
        self._unread: weakref.WeakSet[BinaryIO] = weakref.WeakSet()  # aiohttp closes each

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a file. The browser reads the answer while other files are handled."""
        if sum(not file.closed for file in self._unread) >= MAX_UNREAD_SOUNDS:
            await discard_body(request)
            return _upload_error(503, self.busy_text)
        try:
            with tempfile.TemporaryDirectory(prefix="kouxing-") as folder:
                return await self._decode_upload(Path(folder), request)
        except TimeoutError:
            return _upload_error(408, "reading the file took too long; use a shorter file")
        except ConnectionError:
            raise
        except OSError as error:
            await discard_body(request)
            raise audio_decoder.storage_error(error) from None

    async def _decode_upload(self, folder: Path, request: web.Request) -> web.StreamResponse:
        name = _NOT_IN_NAMES.sub("_", request.query.get("name", ""))[-_MAX_NAME_CHARACTERS:].lstrip(
            "-. "
        )
        source = folder / "in" / (name or "file")
        source.parent.mkdir()
        try:
            is_complete = await asyncio.wait_for(_store(request, source), UPLOAD_TIMEOUT_S)
        except TimeoutError:
            await discard_body(request)
            return _upload_error(
                408,
                f"the file did not arrive within {UPLOAD_TIMEOUT_S:g} s; use a smaller file or a"
                " faster connection",
            )
        if not is_complete:
            await discard_body(request)
            return _upload_error(
                413, f"the file is larger than {MAX_AUDIO_BYTES >> 20} MiB; use a smaller one"
            )
        # Python imports modules from the working folder, so the file must be in another folder
        command = (sys.executable, "-m", audio_decoder.__name__, str(source))
        with contextlib.ExitStack() as stack:
            sound = stack.enter_context(tempfile.TemporaryFile(prefix="kouxing-"))
            status, _, messages = await self.run(request, command, DECODING_TIMEOUT_S, output=sound)
            messages = messages.replace(f"{source.parent}/", "")
            if status == USER_ERROR:
                raise UserError(messages)
            if status != 0:
                LOG.error("decoding an audio file failed with status %d: %s", status, messages)
                raise UserError(f"{source.name}: the file cannot be decoded; export it again")
            sound.seek(0)
            self._unread.add(sound)
            stack.pop_all()  # aiohttp closes the file
        headers = {"Content-Type": "audio/wav", REMARKS_HEADER: quote(messages)}
        return web.Response(body=sound, headers=headers)


class LearnMouthHandler(UploadHandler):
    """Turns a recording of a speaker's lips into a mouth profile, for *Learn my mouth*.

    The browser sends a landmark file (``docs/my_mouth.md``).
    """

    busy_text = "another mouth profile is being created; try again in a minute"

    def __init__(
        self, command: Sequence[str] = (sys.executable, "-m", learning_process.__name__)
    ) -> None:
        super().__init__()
        self._command = command

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a recording."""
        try:
            upload = request.clone(client_max_size=MAX_RECORDING_BYTES)
            recording = await asyncio.wait_for(upload.read(), UPLOAD_TIMEOUT_S)
        except web.HTTPRequestEntityTooLarge:
            await discard_body(request)
            return _upload_error(
                413, f"the recording is larger than {MAX_RECORDING_BYTES >> 20} MiB"
            )
        except TimeoutError:
            await discard_body(request)
            return _upload_error(408, f"the recording did not arrive within {UPLOAD_TIMEOUT_S:g} s")
        try:
            status, profile, messages = await self.run(
                request, self._command, LEARNING_TIMEOUT_S, content=recording
            )
        except TimeoutError:
            return _upload_error(
                503, f"learning took longer than {LEARNING_TIMEOUT_S:g} s; try again later"
            )
        if status == USER_ERROR:
            raise UserError(messages)
        if status != 0:
            LOG.error("learning a mouth profile failed with status %d: %s", status, messages)
            raise UserError("learning failed; see the gateway's log")
        return web.Response(body=profile, content_type="application/json")


def _upload_error(status: int, text: str) -> web.Response:
    return web.json_response({"error": text}, status=status)


async def _store(request: web.Request, path: Path) -> bool:
    """Write the request's body to a file; return False if it is too large."""
    num_bytes = 0
    with path.open("wb") as file:
        async for data in request.content.iter_chunked(_READ_BYTES):
            num_bytes += len(data)
            if num_bytes > MAX_AUDIO_BYTES:
                return False
            file.write(data)
    return True
