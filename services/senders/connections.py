"""What reaches a target: datagrams, or VTube Studio's WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import os
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path

import aiohttp

from kouxing.services.senders import live_link, osc, vmc
from kouxing.services.senders.face import Face
from kouxing.services.senders.target import Target
from kouxing.services.senders.vtube_studio import Denied, Dialogue
from kouxing.shared.errors import UserError
from kouxing.shared.keys import key_folder
from kouxing.shared.logs import LOG

RETRY_S = 1.0
ANSWER_S = 5.0  # for a connection, and for a frame to leave
_REFUSED_S = 1.0  # without a refusal, somebody listens


class Connection(ABC):
    """A way to a target, which comes back by itself.

    Attributes
    ----------
    problem
        What keeps frames from the target; empty: nothing that is known.
    """

    def __init__(self, target: Target) -> None:
        self.target = target
        self.problem = ""

    @abstractmethod
    async def run(self) -> None:
        """Be connected until cancelled, or until only the user can help."""

    @abstractmethod
    def send(self, face: Face) -> bool:
        """Send a frame at once; return whether it left."""


class Datagrams(Connection):
    """UDP: nobody says that a frame arrived, but this machine says that nobody listens."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._socket: socket.socket | None = None
        self._refused_s = -_REFUSED_S

    async def run(self) -> None:
        """Find the host, and open a socket; again after this machine's own address has changed."""
        try:
            while True:
                if self._socket is None:
                    try:
                        self._socket = await self._open()
                        self.problem = ""
                    except OSError as error:
                        self.problem = f"{self.target.host} cannot be reached: {error.strerror}"
                await asyncio.sleep(RETRY_S)
        finally:
            self._close()

    def send(self, face: Face) -> bool:
        """Send the datagrams of a frame; what the system does not take is lost."""
        if self._socket is None:
            return False
        now_s = time.monotonic()
        try:
            for datagram in self._encode(face):
                self._socket.send(datagram)
        except BlockingIOError:
            return False
        except OSError as error:
            self._refused_s = now_s
            where = f"{self.target.host}:{self.target.port}"
            if error.errno == errno.ECONNREFUSED:
                self.problem = f"no program listens at {where}: turn its receiver on"
            else:
                self.problem = f"{where} cannot be reached: {error.strerror}"
                self._close()
            return False
        if now_s - self._refused_s < _REFUSED_S:
            return False
        self.problem = ""
        return True

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    async def _open(self) -> socket.socket:
        found = await asyncio.get_running_loop().getaddrinfo(
            self.target.host, self.target.port, type=socket.SOCK_DGRAM
        )
        # such programs mostly listen at IPv4 alone, and localhost is both
        family, kind, protocol, _, address = min(found, key=lambda each: each[0] != socket.AF_INET)
        opened = socket.socket(family, kind, protocol)
        try:
            opened.setblocking(False)
            opened.connect(address)
        except OSError:
            opened.close()
            raise
        return opened

    def _encode(self, face: Face) -> Iterable[bytes]:
        if self.target.protocol == "vmc":
            return vmc.encode(face, self.target)
        if self.target.protocol == "osc":
            return osc.encode(face, self.target)
        now = datetime.now().astimezone()
        midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
        return [live_link.encode(face, self.target, (now - midnight).total_seconds())]


class VTubeStudio(Connection):
    """A WebSocket that the newest frame goes through, as fast as it takes them."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._address = f"{target.host}:{target.port}"
        self._newest: asyncio.Queue[Face] = asyncio.Queue(1)
        self._is_ready = False

    async def run(self) -> None:
        """Connect again and again, until the user denies it."""
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

    def send(self, face: Face) -> bool:
        """Send a frame, in place of one that waits."""
        if not self._is_ready:
            return False
        if self._newest.full():
            self._newest.get_nowait()
        self._newest.put_nowait(face)
        return True

    async def _talk(self, http: aiohttp.ClientSession) -> None:
        limit = aiohttp.ClientWSTimeout(ws_close=RETRY_S)
        host = f"[{self.target.host}]" if ":" in self.target.host else self.target.host
        async with asyncio.timeout(ANSWER_S):
            vtube_studio = await http.ws_connect(f"ws://{host}:{self.target.port}", timeout=limit)
        async with vtube_studio:
            dialogue = Dialogue(_read_tokens().get(self._address, ""), self._keep_token)
            writer: asyncio.Task[None] | None = None
            try:
                await vtube_studio.send_str(dialogue.begin())
                self.problem = dialogue.problem
                async for message in vtube_studio:
                    if message.type is not aiohttp.WSMsgType.TEXT:
                        continue
                    answer = dialogue.answer(message.data)
                    self.problem = dialogue.problem
                    if answer:
                        await vtube_studio.send_str(answer)
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
            face = await self._newest.get()
            frame = dialogue.frame(face, is_mouth_only=self.target.is_mouth_only)
            async with asyncio.timeout(ANSWER_S):
                await vtube_studio.send_str(frame)

    def _keep_token(self, token: str) -> None:
        _write_tokens({**_read_tokens(), self._address: token})


def connect(target: Target) -> Connection:
    """Return the way to a target."""
    return VTubeStudio(target) if target.protocol == "vts" else Datagrams(target)


def _tokens_file() -> Path:
    return key_folder() / "vtube-studio.json"


def _read_tokens() -> dict[str, str]:
    """Return the tokens that VTube Studio gave, by its address."""
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
        LOG.warning("%s cannot be written, VTube Studio will ask again: %s", path, error.strerror)
