"""The WebSocket to VTube Studio."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
from pathlib import Path

import aiohttp

from kouxing.services.senders.connection import RETRY_S, Connection
from kouxing.services.senders.face_frame import FaceFrame
from kouxing.services.senders.target import Target
from kouxing.services.senders.vtube_studio import Denied, Dialogue
from kouxing.shared.errors import UserError
from kouxing.shared.keys import key_folder
from kouxing.shared.logs import LOG

TIMEOUT_S = 5.0  # of a connection attempt, and of sending a frame


class VTubeStudioConnection(Connection):
    """Sends the newest frame whenever the WebSocket is ready."""

    default_port = 8001

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._address = f"{target.host}:{target.port}"
        self._newest: asyncio.Queue[FaceFrame] = asyncio.Queue(1)
        self._is_ready = False

    async def run(self) -> None:
        """Connect repeatedly until the user denies it."""
        async with aiohttp.ClientSession() as http:
            while True:
                try:
                    await self._talk(http)
                    self.problem = "VTube Studio closed the connection; trying again"
                except UserError as error:
                    self.problem = str(error)
                    if isinstance(error, Denied):
                        return
                except (aiohttp.ClientError, OSError, TimeoutError):
                    self.problem = (
                        f"no VTube Studio at {self._address}: start it, and turn on "
                        "'Start API (allow plugins)' in its settings"
                    )
                finally:
                    self._is_ready = False
                await asyncio.sleep(RETRY_S)

    def send(self, frame: FaceFrame) -> bool:
        """Queue a frame; it replaces a queued one."""
        if not self._is_ready:
            return False
        if self._newest.full():
            self._newest.get_nowait()
        self._newest.put_nowait(frame)
        return True

    async def _talk(self, http: aiohttp.ClientSession) -> None:
        limit = aiohttp.ClientWSTimeout(ws_close=RETRY_S)
        host = f"[{self.target.host}]" if ":" in self.target.host else self.target.host
        async with asyncio.timeout(TIMEOUT_S):
            vtube_studio = await http.ws_connect(f"ws://{host}:{self.target.port}", timeout=limit)
        async with vtube_studio:
            dialogue = Dialogue(_read_tokens().get(self._address, ""), self._save_token)
            writer: asyncio.Task[None] | None = None
            try:
                await vtube_studio.send_str(dialogue.first_message())
                self.problem = dialogue.problem
                async for message in vtube_studio:
                    if message.type is not aiohttp.WSMsgType.TEXT:
                        continue
                    reply = dialogue.reply(message.data)
                    self.problem = dialogue.problem
                    if reply:
                        await vtube_studio.send_str(reply)
                    elif dialogue.is_ready and writer is None:
                        self._is_ready = True
                        writer = asyncio.create_task(self._write(vtube_studio, dialogue))
            finally:
                if writer is not None:
                    writer.cancel()
                    with contextlib.suppress(asyncio.CancelledError, ConnectionError, TimeoutError):
                        await writer

    async def _write(
        self, vtube_studio: aiohttp.ClientWebSocketResponse, dialogue: Dialogue
    ) -> None:
        while True:
            frame = await self._newest.get()
            message = dialogue.frame_message(frame, is_mouth_only=self.target.is_mouth_only)
            async with asyncio.timeout(TIMEOUT_S):
                await vtube_studio.send_str(message)

    def _save_token(self, token: str) -> None:
        _write_tokens({**_read_tokens(), self._address: token})


def _tokens_file() -> Path:
    return key_folder() / "vtube-studio.json"


def _read_tokens() -> dict[str, str]:
    """Return the tokens issued by VTube Studio, by its address."""
    try:
        tokens = json.loads(_tokens_file().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return tokens if isinstance(tokens, dict) else {}


def _write_tokens(tokens: dict[str, str]) -> None:
    path = _tokens_file()
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            json.dump(tokens, file)
    except OSError as error:
        LOG.warning("cannot write %s, so VTube Studio will ask again: %s", path, error.strerror)
