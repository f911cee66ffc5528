"""Sessions and data channels of WebRTC clients."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

import pytest
from kouxing_client import KouxingError, Refused

from kouxing.services.gateway.audio.audio_sessions import AudioClient
from kouxing.services.gateway.audio.sample_sentence import SampleSentence
from kouxing.services.gateway.viewers.viewer_handler import ViewerHandler
from kouxing.services.gateway.web.limits import BURST_S
from kouxing.services.gateway.web.web_application import OpenWebSockets
from kouxing.services.gateway.webrtc.whip_handler import MAX_COMMANDS, WhipHandler, _Client
from kouxing.shared.monitoring.metrics import Metrics
from kouxing.shared.wire.face import FaceSettings
from tests.fake_time import with_fake_time

UNUSED = cast("Any", None)


class FakeSession:
    """Counts interruptions; ``error`` is raised when audio is sent."""

    name = "s"
    is_closed = False

    def __init__(self, error: KouxingError | None = None) -> None:
        self.num_flushes = self.num_packets = self.num_skipped = 0
        self._error = error

    def skip(self, num_frames: int) -> None:
        self.num_skipped += num_frames

    def send(self, pcm: bytes, num_frames: int) -> None:
        if self._error is not None:
            raise self._error
        self.num_packets += 1

    def take_errors(self) -> list[KouxingError]:
        return []

    async def flush(self) -> None:
        self.num_flushes += 1


class FakeChannel:
    """A data channel; ``on_message`` is called with the client's messages."""

    readyState = "open"  # noqa: N815 - as in aiortc
    bufferedAmount = 0  # noqa: N815

    def __init__(self) -> None:
        self.errors: list[str] = []
        self.on_message: Callable[[str], None] = UNUSED

    def on(self, event: str, handler: Callable[[str], None]) -> None:
        assert event == "message"
        self.on_message = handler

    def send(self, message: str) -> None:
        fields = json.loads(message)
        self.errors += [fields["text"]] if fields["type"] == "error" else []


class FakePeer:
    """A connection that ends after a number of packets of 1 s; 160 samples are lost before each."""

    rate_hz = 16_000

    def __init__(self, num_packets: int = 1) -> None:
        self._num_packets = num_packets

    async def receive_audio(self) -> AsyncIterator[tuple[int, bytes, int]]:
        for _ in range(self._num_packets):
            yield 160, bytes(32_000), 16_000


@pytest.fixture
def viewers() -> ViewerHandler:
    return ViewerHandler(
        OpenWebSockets(), 1.0, Metrics(), SampleSentence(UNUSED), UNUSED, lambda: None
    )


@pytest.fixture
def handler(viewers: ViewerHandler) -> WhipHandler:
    return WhipHandler(1.0, cast("AudioClient", None), viewers, [])


@with_fake_time
async def test_the_session_can_end_before_the_connection(
    handler: WhipHandler, viewers: ViewerHandler
) -> None:
    viewers.add_session("s", 1, FaceSettings(), "zh")
    session = cast("Any", FakeSession(Refused("unknown-session", "it has ended")))
    client = _Client(cast("Any", FakePeer()), None, session)
    with viewers.connect_viewer("s", None) as viewer:
        await handler._stream(client, session, contextlib.AsyncExitStack())
        messages = [str(await viewer.queue.get()) for _ in range(len(viewer.queue))]
    assert json.loads(messages[-1])["text"] == "it has ended"
    assert client.is_ending


@with_fake_time
async def test_audio_faster_than_real_time_is_dropped_after_a_burst(handler: WhipHandler) -> None:
    session = cast("Any", FakeSession())
    client = _Client(cast("Any", FakePeer(1000)), None)
    await handler._stream(client, session, contextlib.AsyncExitStack())
    assert session.num_packets == BURST_S
    assert session.num_skipped == 1000 * 160  # media time includes all lost audio


@with_fake_time
async def test_a_data_channel_rejects_what_it_does_not_execute(handler: WhipHandler) -> None:
    session, channel = FakeSession(), FakeChannel()
    client = _Client(UNUSED, None, cast("Any", session))
    handler._clients["c"] = client
    handler._on_channel("c", cast("Any", channel))
    channel.on_message('{"skip": 960, "flush": true}')
    channel.on_message('{"last": true}')
    await asyncio.sleep(1.0)
    assert session.num_flushes == 1
    errors = [error.partition(";")[0] for error in channel.errors]
    assert errors == ["unknown field skip", "unknown field last"]
    channel.errors.clear()
    for _ in range(MAX_COMMANDS + 2):
        channel.on_message('{"flush": true}')
    await asyncio.sleep(100.0)
    assert session.num_flushes == 1 + MAX_COMMANDS
    errors = [error.partition(":")[0] for error in channel.errors]
    assert errors == ["the command is dropped"] * 2
    for task in client.tasks:
        task.cancel()
