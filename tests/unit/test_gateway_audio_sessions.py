"""Sessions that the gateway opens for audio."""

import asyncio
from typing import Any, cast

from kouxing.services.gateway.audio.audio_sessions import AudioClient
from tests.fake_time import with_fake_time

UNUSED = cast("Any", None)


class UnansweredSession:
    """A session whose end control never confirms."""

    name = "s"

    async def finish(self) -> None:
        await asyncio.Future()


class FakeClient:
    """Opens one session."""

    is_closed = False

    async def open_session(self, _: str) -> UnansweredSession:
        return UnansweredSession()


@with_fake_time
async def test_a_session_whose_end_is_cancelled_is_forgotten() -> None:
    client = AudioClient("", None, UNUSED)
    client._client = cast("Any", FakeClient())

    async def stream() -> None:
        async with client.open():
            pass

    task = asyncio.create_task(stream())
    await asyncio.sleep(1.0)
    assert client._open
    task.cancel()
    await asyncio.wait({task})
    assert not client._open
