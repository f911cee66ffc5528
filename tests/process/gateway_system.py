"""A gateway process with a scripted control, and WebSocket clients."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp

from kouxing.services.gateway.wire import REST_TYPE
from kouxing.shared.clock import now_ns
from kouxing.shared.face.faps import MASK_BYTES, NUM_FAPS
from kouxing.shared.keys import Peer
from kouxing.shared.wire.audio import Sound
from kouxing.shared.wire.control import (
    Heartbeat,
    HeartbeatReply,
    SessionStarted,
    StartSession,
)
from kouxing.shared.wire.face import FaceSettings, FapFrame, SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    CloseSession,
    FlushSession,
    OpenSession,
    SessionFacts,
)
from kouxing.shared.wire.speech import Phone, Speech
from tests.fake_control import TOKEN, FakeControl

ROOT = Path(__file__).parents[2]
EPOCH = 3
Socket = aiohttp.ClientWebSocketResponse
FACE = struct.pack(f"<{NUM_FAPS}f", *range(NUM_FAPS))


class ScriptedSystem(FakeControl):
    """Control that serves a gateway. A session opens when the gateway has subscribed to it."""

    def __init__(self) -> None:
        self.page = ""
        self.gateway = Peer()
        self.started: list[str] = []  # sessions that the gateway has confirmed
        self.closed: list[str] = []
        self.flushed: list[str] = []
        self.chosen: list[tuple[str, str]] = []  # session, lip model
        self.expressions: list[SetFace] = []
        self.amounts: list[tuple[str, float]] = []  # session, expressiveness
        self.profiles: list[bytes] = []  # mouth profiles of the opened sessions
        self._openings: dict[str, tuple[OpenSession, Peer]] = {}
        super().__init__()

    def clear_records(self) -> None:
        self.running = ["recognizer", "synthesizer"]
        self.refuse = False
        for records in (
            self.started,
            self.closed,
            self.flushed,
            self.audio_messages,
            self.chosen,
            self.expressions,
            self.amounts,
            self.profiles,
        ):
            records.clear()

    def start(self, session: str, epoch: int = EPOCH) -> None:
        message = StartSession(
            session=session,
            epoch=epoch,
            request=f"start-{session}",
            token=TOKEN,
            encoding="s16le",
            sample_rate_hz=16000,
            num_channels=1,
            record=False,
            paced=True,
            facts=SessionFacts(language="mandarin"),
            endpoints={"phones": self.phones.endpoint, "faps": self.faps.endpoint},
            face=FaceSettings(lip_model="dynamic-visemes"),
        )
        self.commands.send(message, to=self.gateway)

    def publish_all(self, session: str) -> None:
        self.phones.send(
            Sound(session=session, epoch=EPOCH, media_time=320, pcm=b"\x01\x00\xff\x7f")
        )
        self.phones.send(Speech(session=session, epoch=EPOCH, media_time=320, active=True))
        self.publish_phone(session, "iao")
        self.faps.send(
            FapFrame(
                session=session, epoch=EPOCH, media_time=320, values=FACE, mask=bytes(MASK_BYTES)
            )
        )

    def publish_phone(self, session: str, symbol: str) -> None:
        phone = Phone(
            session=session, epoch=EPOCH, media_time=320, index=0, symbol=symbol, duration=1600,
            confidence=0.5, final=False,
        )  # fmt: skip
        self.phones.send(phone)

    def on_open(self, opening: OpenSession, client: Peer) -> None:
        self.profiles.append(opening.mouth_profile or b"")
        session = opening.session or f"s{len(self._openings)}"
        self._openings[session] = (opening, client)
        self.start(session)

    def on_message(self, message: Message, sender: Peer) -> None:
        match message:
            case Heartbeat():
                self.gateway = sender
                self.page = message.endpoints["page"]
                now = now_ns()
                reply = HeartbeatReply(
                    sent_ns=message.sent_ns, received_ns=now, replied_ns=now, control="control-1"
                )
                self.commands.send(reply, to=sender)
            case SessionStarted():
                self.started.append(message.session)
                if message.session in self._openings:
                    self.answer_open(*self._openings[message.session], message.session)
            case CloseSession():
                self.closed.append(message.session)
                self.commands.send(CloseSession(session=message.session), to=self.gateway)
            case FlushSession():
                self.flushed.append(message.session)
            case SetFace():
                self._on_set_face(message)
        super().on_message(message, sender)

    def _on_set_face(self, message: SetFace) -> None:
        face = message.face
        if face.lip_model is not None:
            self.chosen.append((message.session, face.lip_model))
        if face.expressiveness is not None:
            self.amounts.append((message.session, face.expressiveness))
        if face.expressions is not None:
            self.expressions.append(message)
        self.commands.send(message, to=self.gateway)

    def stop_session(self, session: str) -> None:
        message = CloseSession(session=session)
        self.do(lambda: self.commands.send(message, to=self.gateway))


class GatewayProcess:
    """A gateway that has registered with the scripted control."""

    def __init__(self, system: ScriptedSystem, *program: str) -> None:
        self.process = spawn(*program, KOUXING_CONTROL=system.commands.endpoint)
        wait_until(lambda: bool(system.page))
        self.page = system.page

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(60)
        finally:
            self.process.kill()
            if self.process.stderr is not None:
                self.process.stderr.close()


def spawn(*program: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *(program or ("-m", "kouxing.services.gateway"))],
        cwd=ROOT,
        env={**os.environ, "KOUXING_INSECURE": "1", "KOUXING_GATEWAY_PORT": "0", **environment},
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_until(condition: Callable[[], bool], limit_s: float = 60.0) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError
        time.sleep(0.01)


async def until(condition: Callable[[], bool]) -> None:
    await asyncio.to_thread(wait_until, condition)


def async_test(test: Callable[..., Coroutine[None, None, None]]) -> Callable[..., None]:
    """Run a test that is a coroutine."""

    @functools.wraps(test)
    def run(**fixtures: object) -> None:
        asyncio.run(test(**fixtures))

    return run


@asynccontextmanager
async def connected(page: str, *paths: str) -> AsyncIterator[list[Socket]]:
    """Open a WebSocket for each path."""
    async with contextlib.AsyncExitStack() as stack:
        http = await stack.enter_async_context(aiohttp.ClientSession())
        yield [await stack.enter_async_context(http.ws_connect(page + path)) for path in paths]


async def receive_of_session(viewer: Socket) -> aiohttp.WSMessage:
    """Return the next message that is not the face at rest."""
    while True:
        message = await viewer.receive(60)
        if message.type is not aiohttp.WSMsgType.BINARY or message.data[0] != REST_TYPE:
            return message


async def receive_binary(viewer: Socket, message_type: int) -> bytes:
    """Return the next binary message of a type."""
    while True:
        message = await viewer.receive(60)
        assert message.type in (aiohttp.WSMsgType.BINARY, aiohttp.WSMsgType.TEXT)
        if message.type is aiohttp.WSMsgType.BINARY and message.data[0] == message_type:
            return bytes(message.data)


async def receive_json(browser: Socket, message_type: str, **fields: object) -> dict[str, Any]:
    """Return the next text message of a type, with these values of its fields."""
    while True:
        message = await browser.receive(60)
        if message.type in (aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.CLOSE):
            raise EOFError(message_type)
        if message.type is aiohttp.WSMsgType.TEXT:
            content: dict[str, Any] = json.loads(message.data)
            if content["type"] == message_type and fields.items() <= content.items():
                return content
