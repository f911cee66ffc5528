"""Learn my mouth: turn a browser's recording of a speaker's lips into a mouth profile.

The browser sends a landmark file (``docs/my_mouth.md``).
"""

import asyncio
import sys
from collections.abc import Sequence

from aiohttp import web

from kouxing.services.gateway.http import discard_body
from kouxing.services.gateway.uploads import UPLOAD_LIMIT_S, Uploads
from kouxing.services.mouth_profiles import worker
from kouxing.shared.errors import UserError

MAX_BYTES = 8 << 20
LEARNING_LIMIT_S = 180.0


class MouthLearner(Uploads):
    """Answers a recording with the learned mouth profile."""

    busy_text = "another mouth profile is being created; try again in a minute"
    slow_text = (
        f"receiving the recording took longer than {UPLOAD_LIMIT_S:g} s, or learning longer than"
        f" {LEARNING_LIMIT_S:g} s; try again later"
    )
    failed_text = "learning failed; see the gateway's log"
    bad_code = "bad-recording"

    def __init__(self, command: Sequence[str] = (sys.executable, "-m", worker.__name__)) -> None:
        super().__init__()
        self._command = command

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a recording."""
        try:
            upload = request.clone(client_max_size=MAX_BYTES)
            recording = await asyncio.wait_for(upload.read(), UPLOAD_LIMIT_S)
        except web.HTTPRequestEntityTooLarge:
            await discard_body(request)
            text = f"the recording is larger than {MAX_BYTES >> 20} MiB"
            raise UserError(text, "too-large") from None
        profile, _ = await self.run(request, self._command, LEARNING_LIMIT_S, content=recording)
        return web.Response(body=profile, content_type="application/json")
