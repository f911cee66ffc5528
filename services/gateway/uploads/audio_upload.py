"""Decodes audio files for the page's *File* button, like the commands.

The browser sends a file and receives 16-bit WAV, mono.
"""

import asyncio
import re
import sys
import tempfile
from pathlib import Path
from urllib.parse import quote

from aiohttp import web

from kouxing.services.gateway.uploads import audio_decoder
from kouxing.services.gateway.uploads.upload_handler import (
    UPLOAD_TIMEOUT_S,
    UploadHandler,
    upload_error,
)
from kouxing.services.gateway.web.web_application import discard_body
from kouxing.shared.errors import USER_ERROR, UserError
from kouxing.shared.monitoring.logs import LOG

MAX_BYTES = 200 << 20
DECODING_TIMEOUT_S = 60.0
REMARKS_HEADER = "Kouxing-Remarks"
_NOT_IN_NAMES = re.compile(r"[^\w.() -]")
_MAX_NAME_CHARACTERS = 80
_READ_BYTES = 1 << 16


class AudioUploadHandler(UploadHandler):
    """Decodes an uploaded file and answers with its sound."""

    busy_text = "another file is being read; try again in a few seconds"

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a file."""
        try:
            with tempfile.TemporaryDirectory(prefix="kouxing-") as folder:
                return await self._answer_in(Path(folder), request)
        except TimeoutError:
            return upload_error(408, "reading the file took too long; use a shorter file")

    async def _answer_in(self, folder: Path, request: web.Request) -> web.StreamResponse:
        name = _NOT_IN_NAMES.sub("_", request.query.get("name", ""))[-_MAX_NAME_CHARACTERS:].lstrip(
            "-. "
        )
        source, target = folder / "in" / (name or "file"), folder / "out.wav"
        source.parent.mkdir()
        if not await asyncio.wait_for(_store(request, source), UPLOAD_TIMEOUT_S):
            await discard_body(request)
            return upload_error(
                413, f"the file is larger than {MAX_BYTES >> 20} MiB; use a smaller one"
            )
        # Python imports modules from the working folder, which must therefore not be the file's
        # folder.
        command = (sys.executable, "-m", audio_decoder.__name__, str(source))
        with target.open("wb") as output:
            status, _, messages = await self.run(
                request, command, DECODING_TIMEOUT_S, output=output
            )
        messages = messages.replace(f"{source.parent}/", "")
        if status == USER_ERROR:
            raise UserError(messages)
        if status != 0:
            LOG.error("decoding an audio file failed with status %d: %s", status, messages)
            raise UserError(f"{source.name}: the file cannot be decoded; export it again")
        headers = {"Content-Type": "audio/wav", REMARKS_HEADER: quote(messages)}
        response = web.StreamResponse(headers=headers)
        response.content_length = target.stat().st_size
        await response.prepare(request)
        with target.open("rb") as file:
            while data := file.read(_READ_BYTES):
                await response.write(data)
        return response


async def _store(request: web.Request, path: Path) -> bool:
    """Write the request's body to a file; return False if it is too large."""
    num_bytes = 0
    with path.open("wb") as file:
        async for data in request.content.iter_chunked(_READ_BYTES):
            num_bytes += len(data)
            if num_bytes > MAX_BYTES:
                return False
            file.write(data)
    return True
