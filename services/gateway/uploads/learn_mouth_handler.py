"""Serves *Learn my mouth*: turns a browser's recording of a speaker's lips into a mouth profile.

The browser sends a landmark file (``docs/my_mouth.md``).
"""

import asyncio
import sys
from collections.abc import Sequence

from aiohttp import web

from kouxing.services.gateway.uploads.upload_handler import (
    UPLOAD_TIMEOUT_S,
    UploadHandler,
    upload_error,
)
from kouxing.services.gateway.web.web_application import discard_body
from kouxing.services.mouth_profiles import learning_process
from kouxing.shared.errors import USER_ERROR, UserError
from kouxing.shared.monitoring.logs import LOG

MAX_BYTES = 8 << 20
LEARNING_TIMEOUT_S = 180.0


class LearnMouthHandler(UploadHandler):
    """Answers a recording with the learned mouth profile."""

    busy_text = "another mouth profile is being created; try again in a minute"

    def __init__(
        self, command: Sequence[str] = (sys.executable, "-m", learning_process.__name__)
    ) -> None:
        super().__init__()
        self._command = command

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a recording."""
        try:
            upload = request.clone(client_max_size=MAX_BYTES)
            recording = await asyncio.wait_for(upload.read(), UPLOAD_TIMEOUT_S)
        except web.HTTPRequestEntityTooLarge:
            await discard_body(request)
            return upload_error(413, f"the recording is larger than {MAX_BYTES >> 20} MiB")
        except TimeoutError:
            return upload_error(408, f"the recording did not arrive within {UPLOAD_TIMEOUT_S:g} s")
        try:
            status, profile, messages = await self.run(
                request, self._command, LEARNING_TIMEOUT_S, content=recording
            )
        except TimeoutError:
            raise UserError(
                f"learning took longer than {LEARNING_TIMEOUT_S:g} s; try again later"
            ) from None
        if status == USER_ERROR:
            raise UserError(messages)
        if status != 0:
            LOG.error("learning a mouth failed with status %d: %s", status, messages)
            raise UserError("learning failed; see the gateway's log")
        return web.Response(body=profile, content_type="application/json")
