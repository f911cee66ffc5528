"""Sound files for the page's *File* button, decoded as the commands decode them.

The browser sends a file and receives 16-bit WAV, mono. A process of its own decodes the file, so a
malicious file cannot harm the gateway. Nothing is stored.
"""

import asyncio
import re
import sys
import tempfile
from pathlib import Path
from urllib.parse import quote

from aiohttp import web

from kouxing.services.gateway import sound_decoder
from kouxing.services.gateway.http import discard_body
from kouxing.shared.logs import LOG

MAX_BYTES = 200 << 20
UPLOAD_LIMIT_S = 60.0
DECODING_LIMIT_S = 60.0
REMARKS_HEADER = "Kouxing-Remarks"
_NOT_IN_NAMES = re.compile(r"[^\w.() -]")
_MAX_NAME = 80
_PIECE_BYTES = 1 << 16


class SoundUpload:
    """Decodes one file at a time."""

    def __init__(self) -> None:
        self._is_busy = False
        self._process: asyncio.subprocess.Process | None = None

    @property
    def is_decoding(self) -> bool:
        """Whether a process is decoding."""
        return self._process is not None

    def close(self) -> None:
        """Stop the current decoding process."""
        if self._process is not None and self._process.returncode is None:
            self._process.kill()

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Answer a file with its sound, or with an error."""
        if self._is_busy:
            await discard_body(request)
            return _error(503, "another file is being read; try again in a few seconds")
        self._is_busy = True
        try:
            with tempfile.TemporaryDirectory(prefix="kouxing-") as folder:
                return await self._serve_in(Path(folder), request)
        except TimeoutError:
            return _error(408, "reading the file took too long; use a shorter file")
        finally:
            self._is_busy = False

    async def _serve_in(self, folder: Path, request: web.Request) -> web.StreamResponse:
        name = _NOT_IN_NAMES.sub("_", request.query.get("name", ""))[-_MAX_NAME:].lstrip("-. ")
        source, target = folder / "in" / (name or "file"), folder / "out.wav"
        source.parent.mkdir()
        is_small = await asyncio.wait_for(_store(request, source), UPLOAD_LIMIT_S)
        if not is_small:
            await discard_body(request)
            return _error(413, f"the file is larger than {MAX_BYTES >> 20} MiB; use a smaller one")
        status, messages = await self._decode(source, target)
        if status == sound_decoder.REJECTED:
            return _error(422, messages)
        if status != 0:
            LOG.error("decoding a sound file failed with status %d: %s", status, messages)
            return _error(422, f"{source.name}: the file cannot be decoded; export it again")
        headers = {"Content-Type": "audio/wav", REMARKS_HEADER: quote(messages)}
        response = web.StreamResponse(headers=headers)
        response.content_length = target.stat().st_size
        await response.prepare(request)
        with target.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                await response.write(piece)
        return response

    async def _decode(self, source: Path, target: Path) -> tuple[int, str]:
        # Python imports modules from the working folder, so that must not be the file's.
        command = (sys.executable, "-m", sound_decoder.__name__, str(source))
        with target.open("wb") as output:
            self._process = await asyncio.create_subprocess_exec(
                *command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=output,
                stderr=asyncio.subprocess.PIPE,
            )
        try:
            _, messages = await asyncio.wait_for(self._process.communicate(), DECODING_LIMIT_S)
            text = messages.decode(errors="replace").strip()
            return self._process.returncode or 0, text.replace(f"{source.parent}/", "")
        finally:
            self.close()
            self._process = None


async def _store(request: web.Request, path: Path) -> bool:
    """Write the request's body to a file; return False if it is too large."""
    num_bytes = 0
    with path.open("wb") as file:
        async for piece in request.content.iter_chunked(_PIECE_BYTES):
            num_bytes += len(piece)
            if num_bytes > MAX_BYTES:
                return False
            file.write(piece)
    return True


def _error(status: int, text: str) -> web.Response:
    return web.json_response({"error": text}, status=status)
