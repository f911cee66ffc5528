"""Sound files for the page's *File* button, decoded as the commands decode them.

The browser sends a file and receives 16-bit WAV, mono.
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
from kouxing.services.gateway.uploads import UPLOAD_LIMIT_S, Uploads
from kouxing.shared.errors import UserError

MAX_BYTES = 200 << 20
DECODING_LIMIT_S = 60.0
REMARKS_HEADER = "Kouxing-Remarks"
_NOT_IN_NAMES = re.compile(r"[^\w.() -]")
_MAX_NAME = 80
_PIECE_BYTES = 1 << 16


class SoundUpload(Uploads):
    """Answers a file with its sound."""

    busy_text = "another file is being read; try again in a few seconds"
    slow_text = "reading the file took too long; use a shorter file"
    failed_text = "the file cannot be decoded; export it again"
    bad_code = "bad-file"

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a file."""
        with tempfile.TemporaryDirectory(prefix="kouxing-") as folder:
            return await self._answer_in(Path(folder), request)

    async def _answer_in(self, folder: Path, request: web.Request) -> web.StreamResponse:
        name = _NOT_IN_NAMES.sub("_", request.query.get("name", ""))[-_MAX_NAME:].lstrip("-. ")
        source, target = folder / "in" / (name or "file"), folder / "out.wav"
        source.parent.mkdir()
        if not await asyncio.wait_for(_store(request, source), UPLOAD_LIMIT_S):
            await discard_body(request)
            text = f"the file is larger than {MAX_BYTES >> 20} MiB; use a smaller one"
            raise UserError(text, "too-large")
        # -P: the folder of the file must not provide modules
        command = (sys.executable, "-P", "-m", sound_decoder.__name__, source.name)
        with target.open("wb") as output:
            _, messages = await self.run(
                request, command, DECODING_LIMIT_S, output=output, folder=source.parent
            )
        headers = {"Content-Type": "audio/wav", REMARKS_HEADER: quote(messages)}
        response = web.StreamResponse(headers=headers)
        response.content_length = target.stat().st_size
        await response.prepare(request)
        with target.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                await response.write(piece)
        return response


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
