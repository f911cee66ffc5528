"""The connection to VTube Studio, if VTube Studio stops reading; without a network."""

import asyncio
import json
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Self

import aiohttp
import numpy as np
import pytest

from kouxing.services.senders import vtube_studio
from kouxing.services.senders.face_frame import FaceFrame
from kouxing.services.senders.protocols import parse_target
from kouxing.services.senders.vtube_studio import VTubeStudioConnection
from kouxing.shared.face.faps import NUM_FAPS
from tests.fake_time import with_fake_time

FRAME = FaceFrame(np.zeros(NUM_FAPS, np.float32), 0.0)


class FakeWebSocket:
    """VTube Studio, which reads no frames while ``is_busy``."""

    def __init__(self, *, is_busy: bool) -> None:
        self.is_busy = is_busy
        self.num_frames = 0
        self._answers: asyncio.Queue[str] = asyncio.Queue()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        return None

    async def send_str(self, text: str) -> None:
        kind = json.loads(text)["messageType"]
        if kind == "InjectParameterDataRequest":
            if self.is_busy:
                await asyncio.Event().wait()
            self.num_frames += 1
            return
        parameters: dict[str, object] = {"defaultParameters": [], "customParameters": []}
        answers: dict[str, tuple[str, dict[str, object]]] = {
            "AuthenticationRequest": ("AuthenticationResponse", {"authenticated": True}),
            "InputParameterListRequest": ("InputParameterListResponse", parameters),
        }
        answer_kind, data = answers[kind]
        self._answers.put_nowait(json.dumps({"messageType": answer_kind, "data": data}))

    async def close(self) -> None:
        self._answers.put_nowait("")

    async def __aiter__(self) -> AsyncIterator[SimpleNamespace]:
        while text := await self._answers.get():
            yield SimpleNamespace(type=aiohttp.WSMsgType.TEXT, data=text)


class FakeClientSession:
    """Connects to one program after another."""

    def __init__(self, *websockets: FakeWebSocket) -> None:
        self._websockets = iter(websockets)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        return None

    async def ws_connect(self, *_args: object, **_options: object) -> FakeWebSocket:
        return next(self._websockets)


@with_fake_time
async def test_connects_again_if_no_frame_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    busy, awake = FakeWebSocket(is_busy=True), FakeWebSocket(is_busy=False)
    monkeypatch.setattr(vtube_studio, "_read_tokens", lambda: {"127.0.0.1:8001": "token"})
    monkeypatch.setattr(aiohttp, "ClientSession", lambda: FakeClientSession(busy, awake))
    connection = VTubeStudioConnection(parse_target("vts://"))
    task = asyncio.create_task(connection.run())
    async with asyncio.timeout(60.0):
        while not awake.num_frames:
            connection.send(FRAME)
            await asyncio.sleep(0.1)
    task.cancel()
