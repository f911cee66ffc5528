"""WebSocket clients of a gateway."""

import asyncio
import contextlib
import functools
import json
import struct
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
from kouxing_client.field_types import MASK_BYTES
from kouxing_client.messages import FapFrame, Phone, Sound, Speech

from kouxing.services.gateway.messages.browser_messages import REST_TYPE
from kouxing.shared.face.faps import NUM_FAPS
from tests.fake_control import EPOCH, FakeControl
from tests.system import LIMIT_S, wait_until

Socket = aiohttp.ClientWebSocketResponse
FACE = struct.pack(f"<{NUM_FAPS}f", *range(NUM_FAPS))


def publish_phone(control: FakeControl, session: str, symbol: str) -> None:
    phone = Phone(
        session=session, epoch=EPOCH, media_time=320, index=0, symbol=symbol, duration=1600,
        confidence=0.5, final=False,
    )  # fmt: skip
    control.publish(control.phones, phone)


def publish_all(control: FakeControl, session: str) -> None:
    """Publish sound, speech, a phone and a FAP frame of a session."""
    stamp: dict[str, Any] = {"session": session, "epoch": EPOCH, "media_time": 320}
    sound, speech = Sound(**stamp, pcm=b"\x01\x00\xff\x7f"), Speech(**stamp, active=True)
    control.publish(control.phones, sound, speech)
    publish_phone(control, session, "iao")
    control.publish(control.faps, FapFrame(**stamp, packed_values=FACE, mask=bytes(MASK_BYTES)))


async def wait_until_async(condition: Callable[[], object]) -> None:
    await asyncio.to_thread(wait_until, condition)


def async_test(test: Callable[..., Coroutine[None, None, None]]) -> Callable[..., None]:
    """Run a test that is a coroutine."""

    @functools.wraps(test)
    def run(**fixtures: object) -> None:
        asyncio.run(test(**fixtures))

    return run


@asynccontextmanager
async def open_websockets(page: str, *paths: str) -> AsyncIterator[list[Socket]]:
    """Open a WebSocket for each path."""
    async with contextlib.AsyncExitStack() as stack:
        http = await stack.enter_async_context(aiohttp.ClientSession())
        yield [await stack.enter_async_context(http.ws_connect(page + path)) for path in paths]


async def receive_session_message(viewer: Socket) -> aiohttp.WSMessage:
    """Return the next message that is not the face at rest."""
    while True:
        message = await viewer.receive(LIMIT_S)
        if message.type is not aiohttp.WSMsgType.BINARY or message.data[0] != REST_TYPE:
            return message


async def receive_binary(viewer: Socket, message_type: int) -> bytes:
    """Return the next binary message of a type."""
    while True:
        message = await viewer.receive(LIMIT_S)
        assert message.type in (aiohttp.WSMsgType.BINARY, aiohttp.WSMsgType.TEXT)
        if message.type is aiohttp.WSMsgType.BINARY and message.data[0] == message_type:
            return bytes(message.data)


async def receive_json(browser: Socket, message_type: str, **fields: object) -> dict[str, Any]:
    """Return the next text message of a type, with these values of its fields."""
    while True:
        message = await browser.receive(LIMIT_S)
        if message.type in (aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.CLOSE):
            raise EOFError(message_type)
        if message.type is aiohttp.WSMsgType.TEXT:
            content: dict[str, Any] = json.loads(message.data)
            if content["type"] == message_type and fields.items() <= content.items():
                return content
