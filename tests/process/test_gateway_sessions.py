"""The gateway's sessions end, stall and stop; without control, they do not start."""

import signal
from collections.abc import Iterator

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request
from kouxing_client.base import MAX_UNACKNOWLEDGED_MESSAGES
from kouxing_client.messages import EndOfFaps

from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.service import GatewayService
from kouxing.shared.wire.control import SessionStarted
from kouxing.shared.wire.session import AudioChunk, CloseSession, FlushSession
from tests.fake_control import EPOCH, FakeControl
from tests.process.web_clients import (
    async_test,
    open_websockets,
    publish_phone,
    receive_json,
    wait_until_async,
)
from tests.system import LIMIT_S, Gateway, free_port

LONG_TIMEOUT = """
from kouxing.services.gateway.audio import audio_sessions
from kouxing.services.process import serve
audio_sessions.LAST_FRAME_TIMEOUT_S = 600
serve("gateway", None, [])
"""


@pytest.fixture
def gateway(control: FakeControl) -> Iterator[Gateway]:
    gateway = Gateway(control.address)
    assert control.page == gateway.page
    yield gateway
    gateway.stop()


@async_test
async def test_a_microphone_session_closes_after_its_last_frame(control: FakeControl) -> None:
    gateway = Gateway(control.address, "-c", LONG_TIMEOUT)
    assert control.page == gateway.page
    async with open_websockets(gateway.page, "microphone") as (microphone,):
        await microphone.send_json({"sample_rate_hz": 48000, "num_channels": 1})
        session = (await receive_json(microphone, "opened"))["session"]
        for _ in range(5):
            await microphone.send_bytes(b"\x01\x00" * 960)
        await wait_until_async(lambda: len(control.audio_messages) == 5)
    await wait_until_async(lambda: len(control.audio_messages) == 6)
    assert not control.messages_of(CloseSession)  # before the last frame has arrived
    control.publish(control.faps, EndOfFaps(session=session, epoch=EPOCH))
    await wait_until_async(lambda: control.sessions_of(CloseSession) == [session])
    gateway.stop()
    *chunks, last = control.audio_messages
    assert [chunk.media_time for chunk in chunks] == [0, 320, 640, 960, 1280]
    assert all(isinstance(chunk, AudioChunk) and len(chunk.pcm) == 1920 for chunk in chunks)
    assert isinstance(last, AudioChunk)
    assert last.last


@async_test
async def test_dropped_audio_leaves_a_gap_in_media_time(
    control: FakeControl, gateway: Gateway
) -> None:
    control.audio_endpoint = f"tcp://127.0.0.1:{free_port()}"  # not bound yet
    num_chunks = MAX_UNACKNOWLEDGED_MESSAGES + 100
    last_pcm = b"\x02\x00" * 320
    async with open_websockets(gateway.page, "microphone") as (microphone,):
        await microphone.send_json({"sample_rate_hz": 16000})
        await receive_json(microphone, "opened")
        for _ in range(num_chunks):
            await microphone.send_bytes(b"\x01\x00" * 320)
        await microphone.send_json({"flush": True})
        # the gateway has then read all chunks
        await wait_until_async(lambda: control.messages_of(FlushSession))
        control.run_job(control.bind_audio)
        await wait_until_async(lambda: len(control.audio_messages) == MAX_UNACKNOWLEDGED_MESSAGES)
        await microphone.send_json({"skip": 320})
        await microphone.send_bytes(last_pcm)
        await wait_until_async(lambda: len(control.audio_messages) > MAX_UNACKNOWLEDGED_MESSAGES)
    *queued, last = control.audio_messages[: MAX_UNACKNOWLEDGED_MESSAGES + 1]
    assert [chunk.media_time for chunk in queued] == [
        320 * n for n in range(MAX_UNACKNOWLEDGED_MESSAGES)
    ]
    assert isinstance(last, AudioChunk)
    assert last.pcm == last_pcm
    assert last.media_time == 320 * (num_chunks + 1)
    assert last.sequence == MAX_UNACKNOWLEDGED_MESSAGES + 1


@async_test
async def test_the_sample_sentence_plays_once_and_sigterm_closes_viewers(
    control: FakeControl, gateway: Gateway
) -> None:
    async with open_websockets(gateway.page, "viewer", "viewer") as viewers:
        for viewer in viewers:
            await viewer.send_json({"play": "sample"})
        shown = [await receive_json(viewer, "session", sample=True) for viewer in viewers]
        names = {message["session"] for message in shown}
        await wait_until_async(lambda: len(control.audio_messages) > 10)
        assert names == {*control.sessions_of(SessionStarted)}
        publish_phone(control, names.pop(), "n")
        await receive_json(viewers[0], "syllable", symbol="你")
        gateway.process.send_signal(signal.SIGTERM)
        with pytest.raises(EOFError):
            await receive_json(viewers[1], "never")
        assert viewers[1].close_code == aiohttp.WSCloseCode.GOING_AWAY
    assert gateway.process.wait(LIMIT_S) == 0
    assert control.sessions_of(CloseSession) == control.sessions_of(SessionStarted)


@async_test
async def test_after_the_sample_sentence_the_requested_session_is_shown(
    control: FakeControl, gateway: Gateway
) -> None:
    async with open_websockets(gateway.page, "viewer?session=talk", "viewer") as viewers:
        for name in ("talk", "newest"):
            control.start(name)
            await receive_json(viewers[1], "session", session=name)
        for viewer in viewers:
            await viewer.send_json({"play": "sample"})
        shown = [await receive_json(viewer, "session", sample=True) for viewer in viewers]
        control.stop_session(shown[0]["session"])
        for viewer, name in zip(viewers, ("talk", "newest"), strict=True):
            await receive_json(viewer, "session", session=name)


@async_test
async def test_without_control_browsers_show_how_to_start_it() -> None:
    gateway = Gateway("tcp://127.0.0.1:9")
    async with open_websockets(gateway.page, "viewer", "microphone") as (viewer, microphone):
        await receive_json(viewer, "status", missing=["control"])
        await microphone.send_json({"sample_rate_hz": 16000})
        text = (await receive_json(microphone, "error"))["text"]
    assert "does not answer" in text
    assert "kouxing run" in text
    assert gateway.stop() == 0


def test_requests_are_answered_until_http_stops(
    control: FakeControl, monkeypatch: pytest.MonkeyPatch
) -> None:
    gateway = GatewayService(GatewayConfig(control=control.address, port=0, insecure=True))
    stop = gateway._server.stop

    async def answer_and_stop() -> None:
        answers.append(await gateway._senders.serve_get(make_mocked_request("GET", "/senders")))
        await stop()

    answers: list[web.StreamResponse] = []
    monkeypatch.setattr(gateway._server, "stop", answer_and_stop)
    gateway.on_startup()
    gateway.on_shutdown()
    gateway.bus.close()
    assert [answer.status for answer in answers] == [200]
