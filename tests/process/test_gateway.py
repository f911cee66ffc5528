"""One real gateway process between a scripted system and WebSocket clients."""

from __future__ import annotations

import asyncio
import base64
import csv
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray
from pythonosc.osc_bundle import OscBundle

from kouxing.services.gateway.sample import SAMPLE_FILE, SAMPLE_TEXT
from kouxing.services.gateway.wire import FAP_TYPE, REST_SHAPES_TYPE, REST_TYPE, SHAPES_TYPE
from kouxing.shared.bus import AUDIO_QUEUE_LENGTH
from kouxing.shared.clock import now_ns
from kouxing.shared.face.faps import MASK_BYTES, MOUTH_FAPS, NUM_FAPS
from kouxing.shared.face.shapes import VRM
from kouxing.shared.keys import Peer
from kouxing.shared.wire.audio import AudioChunk, Sound
from kouxing.shared.wire.control import (
    Heartbeat,
    HeartbeatReply,
    SessionStarted,
    StartSession,
    StopSession,
)
from kouxing.shared.wire.face import EndOfFaps, FaceSettings, FapFrame, SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    CloseSession,
    FlushSession,
    OpenSession,
    SessionFacts,
)
from kouxing.shared.wire.speech import Phone, Speech
from tests.fake_control import TOKEN, FakeControl
from tests.system import DEMO, free_port

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
EPOCH = 3
PATIENT = """
from kouxing.services.gateway import audio_sessions
from kouxing.services.process import run_module
audio_sessions.LAST_FRAME_TIMEOUT_S = 600
run_module("gateway")
"""
FACE = struct.pack(f"<{NUM_FAPS}f", *range(NUM_FAPS))


class ScriptedSystem(FakeControl):
    """Control that also serves a gateway, which it waits for when a session opens."""

    def __init__(self) -> None:
        self.page = ""
        self.gateway = Peer()
        self.started: list[str] = []  # sessions that the gateway has confirmed
        self.closed: list[str] = []
        self.flushed: list[str] = []
        self.chosen: list[tuple[str, str]] = []  # session, lip model
        self.expressions: list[SetFace] = []
        self.amounts: list[tuple[str, float]] = []  # session, expressiveness
        self.profiles: list[bytes] = []  # of the mouths of the sessions opened
        self._openings: dict[str, tuple[OpenSession, Peer]] = {}
        super().__init__()

    def forget(self) -> None:
        self.running = ["recognizer", "synthesizer"]
        self.refuse = False
        for received in (
            self.started,
            self.closed,
            self.flushed,
            self.audio_messages,
            self.chosen,
            self.expressions,
            self.amounts,
            self.profiles,
        ):
            received.clear()

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
            face=FaceSettings(lips="dynamic-visemes"),
        )
        self.commands.send(message, to=self.gateway)

    def publish_all(self, session: str) -> None:
        self.phones.send(
            Sound(session=session, epoch=EPOCH, media_time=320, pcm=b"\x01\x00\xff\x7f")
        )
        self.phones.send(Speech(session=session, epoch=EPOCH, media_time=320, active=True))
        self.phones.send(
            Phone(
                session=session,
                epoch=EPOCH,
                media_time=320,
                index=0,
                symbol="iao",
                duration=1600,
                confidence=0.5,
                final=False,
            )
        )
        self.faps.send(
            FapFrame(
                session=session, epoch=EPOCH, media_time=320, values=FACE, mask=bytes(MASK_BYTES)
            )
        )

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
                self.commands.send(StopSession(session=message.session), to=self.gateway)
            case FlushSession():
                self.flushed.append(message.session)
            case SetFace():
                self._on_set_face(message)
        super().on_message(message, sender)

    def _on_set_face(self, message: SetFace) -> None:
        face = message.face
        if face.lips is not None:
            self.chosen.append((message.session, face.lips))
        if face.expressiveness is not None:
            self.amounts.append((message.session, face.expressiveness))
        if face.expressions is not None:
            self.expressions.append(message)
        self.commands.send(message, to=self.gateway)


class GatewayProcess:
    """A gateway that has registered with the scripted control."""

    def __init__(self, system: ScriptedSystem, *program: str) -> None:
        self.system = system
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


def can_connect(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


async def until(condition: Callable[[], bool]) -> None:
    await asyncio.to_thread(wait_until, condition)


async def receive_of_session(browser: aiohttp.ClientWebSocketResponse) -> aiohttp.WSMessage:
    """Return the next message that is not of the face at rest."""
    while True:
        message = await browser.receive(60)
        if message.type is not aiohttp.WSMsgType.BINARY or message.data[0] != REST_TYPE:
            return message


async def receive_binary(browser: aiohttp.ClientWebSocketResponse, kind: int) -> bytes:
    """Return the next binary message of a type."""
    while True:
        message = await browser.receive(60)
        if message.type is aiohttp.WSMsgType.BINARY and message.data[0] == kind:
            found: bytes = message.data
            return found
        assert message.type in (aiohttp.WSMsgType.BINARY, aiohttp.WSMsgType.TEXT)


async def receive_json(browser: aiohttp.ClientWebSocketResponse, kind: str) -> dict[str, Any]:
    """Return the next text message of a kind."""
    while True:
        message = await browser.receive(60)
        if message.type is aiohttp.WSMsgType.TEXT and json.loads(message.data)["type"] == kind:
            found: dict[str, Any] = json.loads(message.data)
            return found
        if message.type in (aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.CLOSE):
            raise EOFError(kind)


@pytest.fixture(scope="module")
def one_system() -> Iterator[ScriptedSystem]:
    system = ScriptedSystem()
    yield system
    system.close()


@pytest.fixture(scope="module")
def one_gateway(one_system: ScriptedSystem) -> Iterator[GatewayProcess]:
    gateway = GatewayProcess(one_system)
    yield gateway
    assert gateway.stop() == 0


@pytest.fixture
def system(one_system: ScriptedSystem) -> ScriptedSystem:
    """The system that all tests share, with nothing remembered of the one before."""
    one_system.forget()
    return one_system


@pytest.fixture
def gateway(one_gateway: GatewayProcess) -> GatewayProcess:
    return one_gateway


@pytest.fixture
def own_system() -> Iterator[ScriptedSystem]:
    system = ScriptedSystem()
    yield system
    system.close()


@pytest.fixture
def own_gateway(own_system: ScriptedSystem) -> Iterator[GatewayProcess]:
    gateway = GatewayProcess(own_system)
    yield gateway
    gateway.stop()


def test_the_face_lives_before_any_session(gateway: GatewayProcess) -> None:
    async def look() -> NDArray[np.float32]:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}viewer?session=later") as viewer,
        ):
            faces: list[NDArray[np.float32]] = []
            while len(faces) < 25:
                message = await viewer.receive(60)
                if message.type is aiohttp.WSMsgType.BINARY:
                    assert struct.unpack_from("<B3xId", message.data) == (REST_TYPE, 0, 0.0)
                    faces.append(np.frombuffer(message.data, "<f4", offset=16))
            return np.array(faces)

    faces = asyncio.run(look())
    assert faces.shape[1:] == (NUM_FAPS,)
    moved = np.flatnonzero(np.ptp(faces, axis=0)) + 1
    assert {48, 49, 50} <= {*moved.tolist()}  # the head
    assert not {*moved.tolist()} & {*MOUTH_FAPS}


def test_a_session_reaches_its_viewers(system: ScriptedSystem, gateway: GatewayProcess) -> None:
    async def look() -> None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}viewer") as newest,
            http.ws_connect(f"{gateway.page}viewer?session=other") as other,
        ):
            while (await receive_json(newest, "status"))["missing"]:
                pass
            system.do(lambda: system.start("one"))
            await until(lambda: system.started == ["one"])
            system.do(lambda: system.publish_all("one"))
            shown = await receive_json(newest, "session")
            assert (shown["session"], shown["lips"]) == ("one", "dynamic-visemes")
            assert shown["sample"] is False
            got = [await receive_of_session(newest) for _ in range(5)]
            binary = {m.data[0]: m.data for m in got if m.type is aiohttp.WSMsgType.BINARY}
            texts = [json.loads(m.data) for m in got if m.type is aiohttp.WSMsgType.TEXT]
            assert struct.unpack_from("<B3xId", binary[1]) == (1, EPOCH, 320.0)
            assert binary[1][16:] == FACE
            assert binary[2][16:] == b"\x01\x00\xff\x7f"
            symbols = {text["type"]: text.get("symbol") for text in texts}
            assert symbols == {"speech": None, "phone": "iao", "syllable": "yao"}

            await other.send_json({"follow": "one"})
            assert (await receive_json(other, "session"))["session"] == "one"
            system.do(lambda: system.start("one", epoch=EPOCH + 1))
            restarted = await receive_json(newest, "session")
            assert (restarted["session"], restarted["epoch"]) == ("one", EPOCH + 1)
            await until(lambda: system.started == ["one", "one"])
            system.do(lambda: system.commands.send(StopSession(session="one"), to=system.gateway))
            assert (await receive_json(newest, "session"))["session"] is None
            await other.send_str("[[[[")
            assert (await receive_json(other, "error"))["code"] == "refused"

    asyncio.run(look())


def test_a_viewer_gets_shapes_in_the_form_it_asks_for(
    system: ScriptedSystem, gateway: GatewayProcess
) -> None:
    page = f"{gateway.page}viewer?session=shaped&shapes=vrm"
    weights = VRM.weights(np.frombuffer(FACE, "<f4"))

    async def look() -> None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(page) as binary,
            http.ws_connect(f"{page}&format=json") as text,
            http.ws_connect(f"{page}&format=msgpack") as packed,
        ):
            for viewer in (binary, text, packed):
                hello = await receive_json(viewer, "shapes")
                assert (hello["set"], tuple(hello["names"])) == ("vrm", VRM.names)
            assert len((await receive_binary(binary, REST_SHAPES_TYPE))[16:]) == 4 * len(VRM.names)
            assert set((await receive_json(text, "rest"))["weights"]) == {*VRM.names}
            system.do(lambda: system.start("shaped"))
            await until(lambda: system.started == ["shaped"])
            system.do(lambda: system.publish_all("shaped"))
            assert (await receive_binary(binary, FAP_TYPE))[16:] == FACE
            shapes = await receive_binary(binary, SHAPES_TYPE)
            assert struct.unpack_from("<B3xId", shapes) == (SHAPES_TYPE, EPOCH, 320.0)
            np.testing.assert_array_equal(np.frombuffer(shapes, "<f4", offset=16), weights)
            frames = [await receive_json(text, "weights")]
            while len(frames) < 2:
                message = await packed.receive(60)
                if message.type is aiohttp.WSMsgType.BINARY and message.data[0] >= 0x80:
                    frames += [each for each in [msgpack.unpackb(message.data)] if each["epoch"]]
            for frame in frames:
                assert (frame["type"], frame["set"]) == ("weights", "vrm")
                assert (frame["epoch"], frame["media_time"]) == (EPOCH, 320)
                assert [*frame["weights"]] == [*VRM.names]
                np.testing.assert_allclose([*frame["weights"].values()], weights, atol=1e-4)
            system.do(
                lambda: system.commands.send(StopSession(session="shaped"), to=system.gateway)
            )
            for wrong in ("shapes=face", "shapes=vrm&format=xml"):
                async with http.get(f"{gateway.page}viewer?{wrong}") as answer:
                    assert answer.status == 400
                    assert "one of" in await answer.text()

    asyncio.run(look())


def test_writing_to_a_browser_that_is_gone_is_no_end(gateway: GatewayProcess) -> None:
    gateway.process.send_signal(signal.SIGPIPE)  # what such a write raises

    with pytest.raises(subprocess.TimeoutExpired):
        gateway.process.wait(0.3)


def test_what_is_no_http_is_one_line_in_the_log(own_gateway: GatewayProcess) -> None:
    address = urlsplit(own_gateway.page)
    for garbage in (b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01" * 100, b"\xff\x00" * 5000):
        with socket.create_connection((address.hostname, address.port), 60) as stranger:
            stranger.sendall(garbage)
            assert b" 400 " in stranger.recv(100)
    own_gateway.process.terminate()
    assert own_gateway.process.stderr is not None
    log = own_gateway.process.stderr.read()
    assert log.count("not HTTP") == 1
    assert "raceback" not in log


def test_viewers_hear_what_is_missing(system: ScriptedSystem, gateway: GatewayProcess) -> None:
    async def look() -> None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}viewer") as browser,
        ):
            while (await receive_json(browser, "status"))["missing"]:
                pass
            system.running.remove("recognizer")
            assert (await receive_json(browser, "status"))["missing"] == ["recognizer"]

    asyncio.run(look())


def test_a_microphone_streams_and_says_its_last(own_system: ScriptedSystem) -> None:
    system, gateway = own_system, GatewayProcess(own_system, "-c", PATIENT)

    async def speak() -> None:
        async with aiohttp.ClientSession() as http:
            async with http.ws_connect(f"{gateway.page}microphone") as browser:
                await browser.send_json({"sample_rate_hz": 48000, "num_channels": 1})
                session = (await receive_json(browser, "opened"))["session"]
                for _ in range(5):
                    await browser.send_bytes(b"\x01\x00" * 960)
                await until(lambda: len(system.audio_messages) == 5)
            await until(lambda: len(system.audio_messages) == 6)
            assert not system.closed  # before the last frame has come
            system.do(lambda: system.faps.send(EndOfFaps(session=session, epoch=EPOCH)))
            await until(lambda: system.closed == [session])

    try:
        asyncio.run(speak())
    finally:
        gateway.stop()
    *chunks, last = system.audio_messages
    assert [chunk.media_time for chunk in chunks] == [0, 320, 640, 960, 1280]
    assert all(isinstance(chunk, AudioChunk) and len(chunk.pcm) == 1920 for chunk in chunks)
    assert isinstance(last, AudioChunk)
    assert last.last


def test_audio_that_had_to_be_dropped_leaves_a_gap_in_media_time(
    own_system: ScriptedSystem, own_gateway: GatewayProcess
) -> None:
    system, gateway = own_system, own_gateway
    system.audio_endpoint = f"tcp://127.0.0.1:{free_port()}"  # nobody is there yet
    num_chunks = AUDIO_QUEUE_LENGTH + 100
    last_pcm = b"\x02\x00" * 320

    async def speak() -> None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}microphone") as browser,
        ):
            await browser.send_json({"sample_rate_hz": 16000})
            await receive_json(browser, "opened")
            for _ in range(num_chunks):
                await browser.send_bytes(b"\x01\x00" * 320)
            await browser.send_json({"flush": True})
            await until(lambda: bool(system.flushed))  # the gateway has taken all of them
            system.do(system.bind_audio)
            await until(lambda: len(system.audio_messages) == AUDIO_QUEUE_LENGTH)
            await browser.send_json({"skip": 320})  # what the network was too slow for
            await browser.send_bytes(last_pcm)
            await until(lambda: len(system.audio_messages) > AUDIO_QUEUE_LENGTH)

    asyncio.run(speak())
    *queued, last = system.audio_messages[: AUDIO_QUEUE_LENGTH + 1]
    assert [chunk.media_time for chunk in queued] == [320 * n for n in range(AUDIO_QUEUE_LENGTH)]
    assert isinstance(last, AudioChunk)
    assert last.pcm == last_pcm
    assert last.media_time == 320 * (num_chunks + 1)
    assert last.sequence == AUDIO_QUEUE_LENGTH + 1


def test_the_sample_sentence_is_streamed_once_for_whoever_asks(
    own_system: ScriptedSystem, own_gateway: GatewayProcess
) -> None:
    system, gateway = own_system, own_gateway

    async def ask() -> None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}viewer") as browser,
            http.ws_connect(f"{gateway.page}viewer") as other,
        ):
            await browser.send_json({"play": "sample"})
            await other.send_json({"play": "sample"})
            names = set()
            for viewer in (browser, other):
                while (name := (await receive_json(viewer, "session"))["session"]) is None:
                    pass
                names.add(name)
            await until(lambda: len(system.audio_messages) > 10)
            assert names == set(system.started)
            phone = Phone(
                session=names.pop(),
                epoch=EPOCH,
                media_time=320,
                index=0,
                symbol="n",
                duration=1600,
                confidence=0.5,
                final=False,
            )
            system.do(lambda: system.phones.send(phone))
            assert (await receive_json(browser, "syllable"))["symbol"] == "你"

    asyncio.run(ask())
    assert gateway.stop() == 0
    assert system.closed == system.started


def test_the_text_of_the_sample_is_its_transcript() -> None:
    with (DEMO / "transcripts.tsv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    texts = [row["text"] for row in rows if row["file"] == SAMPLE_FILE.name]
    assert texts == [SAMPLE_TEXT]


def test_microphone_and_sample_may_choose_their_lips(
    own_system: ScriptedSystem, own_gateway: GatewayProcess
) -> None:
    system, gateway = own_system, own_gateway

    async def choose() -> None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}viewer") as viewer,
            http.ws_connect(f"{gateway.page}microphone") as browser,
        ):
            await browser.send_json({"sample_rate_hz": 16000})
            await receive_json(browser, "opened")
            await browser.send_json({"lips": "learnt"})
            await until(lambda: len(system.chosen) == 1)
            await browser.send_json({"lips": "dynamic-visemes"})
            await until(lambda: len(system.chosen) == 2)
            assert (await receive_json(viewer, "lips"))["lips"] == "learnt"
            assert (await receive_json(viewer, "lips"))["lips"] == "dynamic-visemes"
            await viewer.send_json({"play": "sample", "lips": "muscles"})
            assert "lips must be one of" in (await receive_json(viewer, "error"))["text"]
            await viewer.send_json({"lips": "learnt"})
            assert "of the sample sentence only" in (await receive_json(viewer, "error"))["text"]
            await viewer.send_json({"play": "sample", "lips": "learnt"})
            await until(lambda: len(system.chosen) == 3)
            while not (await receive_json(viewer, "session"))["sample"]:
                pass
            await viewer.send_json({"lips": "dynamic-visemes"})
            await until(lambda: len(system.chosen) == 4)
            sample = system.chosen[3][0]
            system.do(lambda: system.commands.send(StopSession(session=sample), to=system.gateway))
            while (shown := await receive_json(viewer, "session"))["session"] == sample:
                pass
            assert shown["sample"] is False

    asyncio.run(choose())
    (first, second, third, fourth) = system.chosen
    assert first[0] == second[0] != third[0] == fourth[0]
    assert [first[1], second[1]] == [third[1], fourth[1]] == ["learnt", "dynamic-visemes"]


def test_a_viewer_lets_the_face_it_sees_express_something(
    system: ScriptedSystem, gateway: GatewayProcess
) -> None:
    async def express() -> None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}viewer?session=seen") as viewer,
        ):
            await viewer.send_json({"express": {"joy": 0.5}})
            assert "no session is shown" in (await receive_json(viewer, "error"))["text"]
            system.do(lambda: system.start("seen"))
            while (await receive_json(viewer, "session"))["session"] != "seen":
                pass
            for wrong, named in (
                ({"express": {"glee": 0.5}}, "use joy, sadness,"),
                ({"express": {"joy": 2}}, "joy is 2"),
                ({"express": {"joy": 1}, "hold_s": "long"}, "hold_s is long"),
                ({"express": "joy"}, "strengths by name"),
                ({"expressiveness": 3}, "expressiveness is 3; give 0.5 to 2"),
            ):
                await viewer.send_json(wrong)
                assert named in (await receive_json(viewer, "error"))["text"]
            await viewer.send_json({"express": {"joy": 0.5, "squint": 1}, "hold_s": 7})
            await viewer.send_json({"express": {}})
            await viewer.send_json({"expressiveness": 2})
            await until(lambda: len(system.expressions) == 2 and bool(system.amounts))

    asyncio.run(express())
    first, second = system.expressions
    assert (first.session, first.face.expressions, first.face.hold_s) == (
        "seen",
        {"joy": 0.5, "squint": 1.0},
        7.0,
    )
    assert (second.session, second.face.expressions) == ("seen", {})
    assert system.amounts == [("seen", 2.0)]
    system.do(lambda: system.commands.send(StopSession(session="seen"), to=system.gateway))


def test_bad_microphones_are_told_why(system: ScriptedSystem, gateway: GatewayProcess) -> None:
    async def error_after(http: aiohttp.ClientSession, *messages: str | bytes) -> str:
        async with http.ws_connect(f"{gateway.page}microphone") as browser:
            for message in messages:
                if isinstance(message, str):
                    await browser.send_str(message)
                else:
                    await browser.send_bytes(message)
            text: str = (await receive_json(browser, "error"))["text"]
            return text

    async def speak() -> None:
        async with aiohttp.ClientSession() as http:
            hello = json.dumps({"sample_rate_hz": 16000})
            assert "sample_rate_hz" in await error_after(http, '{"sample_rate_hz": 4000}')
            assert "describes the audio" in await error_after(http, b"\x00\x00")
            assert "multiple of 2" in await error_after(http, hello, b"\x00\x00\x00")
            async with http.ws_connect(f"{gateway.page}microphone") as browser:
                await browser.send_str(hello)
                await receive_json(browser, "opened")
                await browser.send_bytes(bytes(300 * 1024))
                assert (await browser.receive(60)).type is aiohttp.WSMsgType.CLOSE
                assert browser.close_code == aiohttp.WSCloseCode.MESSAGE_TOO_BIG
            system.refuse = True
            assert await error_after(http, hello) == "start one"

    asyncio.run(speak())


def test_without_control_browsers_are_told_to_start_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
    process = spawn(KOUXING_GATEWAY_PORT=port, KOUXING_CONTROL="tcp://127.0.0.1:9")

    async def ask() -> tuple[list[str], str]:
        page = f"http://127.0.0.1:{port}/"
        async with aiohttp.ClientSession() as http:
            async with http.ws_connect(f"{page}viewer") as viewer:
                status = await receive_json(viewer, "status")
            async with http.ws_connect(f"{page}microphone") as browser:
                await browser.send_json({"sample_rate_hz": 16000})
                return status["missing"], (await receive_json(browser, "error"))["text"]

    try:
        wait_until(lambda: can_connect(int(port)))
        missing, text = asyncio.run(ask())
    finally:
        process.terminate()
        process.communicate(timeout=60)
    assert missing == ["control"]
    assert "does not answer. Start it with 'kouxing run'" in text
    assert process.returncode == 0


def test_strange_pages_and_paths_are_refused(gateway: GatewayProcess) -> None:
    async def status(http: aiohttp.ClientSession, path: str, **headers: str) -> int:
        async with http.get(gateway.page + path, headers=headers) as answer:
            return answer.status

    async def knock() -> None:
        upgrade = {
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        }
        async with aiohttp.ClientSession() as http:
            assert await status(http, "viewer", Origin="http://evil.example", **upgrade) == 403
            assert await status(http, "microphone", Origin="null", **upgrade) == 403
            assert await status(http, "", Host="evil.example") == 403
            assert await status(http, "viewer?session=..%2F", **upgrade) == 400
            for path in (
                "..%2Fservice.py",
                "package.json",
                "tests%2Fplayout.test.js",
                "tests/playout.test.js",
                "modules/three/build/..%2Fpackage.json",
            ):
                assert await status(http, path) in (403, 404)
            async with http.get(gateway.page) as answer:
                policy = answer.headers["Content-Security-Policy"]
                assert "default-src 'self'" in policy
                assert "unsafe" not in policy

    asyncio.run(knock())


def test_only_the_face_meshs_frame_may_make_functions_from_text_and_it_sees_no_camera(
    gateway: GatewayProcess,
) -> None:
    async def look() -> None:
        async with aiohttp.ClientSession() as http:
            async with http.get(f"{gateway.page}face-mesh.html") as answer:
                policy = answer.headers["Content-Security-Policy"]
                assert "script-src 'self' 'unsafe-eval'" in policy
                assert "frame-ancestors 'self'" in policy
                assert answer.headers["Permissions-Policy"] == "camera=(), microphone=()"
            for name, kind in (
                ("face_mesh.js", "javascript"),
                ("face_mesh.binarypb", "application/octet-stream"),
                ("face_mesh_solution_simd_wasm_bin.wasm", "application/wasm"),
                ("face_mesh_solution_packed_assets.data", "application/octet-stream"),
            ):
                async with http.get(f"{gateway.page}modules/face_mesh/{name}") as answer:
                    assert answer.status == 200
                    assert answer.content_type.endswith(kind)
                    assert answer.headers["X-Content-Type-Options"] == "nosniff"
            for name in ("package.json", "index.d.ts", "..%2F..%2Fthree%2Fpackage.json", "no.js"):
                async with http.get(f"{gateway.page}modules/face_mesh/{name}") as answer:
                    assert answer.status == 404

    asyncio.run(look())


def test_the_microphone_sends_the_mouth_profile(
    system: ScriptedSystem, gateway: GatewayProcess
) -> None:
    profile = bytes(range(256)) * 256  # 64 KiB, the largest

    async def speak() -> None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}microphone") as browser,
        ):
            voice = base64.b64encode(profile).decode()
            await browser.send_json({"sample_rate_hz": 16000, "voice": voice})
            await receive_json(browser, "opened")

    asyncio.run(speak())
    assert system.profiles == [profile]


def test_the_page_sends_the_newest_face_to_another_program(
    system: ScriptedSystem, gateway: GatewayProcess
) -> None:
    async def look(program: socket.socket) -> None:
        url = f"osc://127.0.0.1:{program.getsockname()[1]}"
        async with aiohttp.ClientSession() as http:
            for command in (
                {"start": "nonsense"}, {"start": "osc://192.0.2.1"}, {}, {"delay_ms": -1},
                {"delay_ms": 10**400},
            ):  # fmt: skip
                async with http.post(f"{gateway.page}senders", json=command) as answer:
                    assert answer.status == 422
                    assert (await answer.json())["error"]
            async with http.post(f"{gateway.page}senders", json={"start": url}) as answer:
                assert [each["target"] for each in (await answer.json())["senders"]] == [url]
            await until(lambda: time_sent(program) > 1.0)  # a face at rest
            system.do(lambda: system.start("older"))
            system.do(lambda: system.start("newer"))
            await until(lambda: {"older", "newer"} <= {*system.started})
            system.do(lambda: system.publish_all("older"))
            system.do(lambda: system.publish_all("newer"))
            await until(lambda: time_sent(program) == 320 / 16000)
            async with http.get(f"{gateway.page}senders") as answer:
                (state,) = (await answer.json())["senders"]
            assert state["rate_hz"] > 0
            assert (state["contents"], state["problem"]) == ("ARKit shapes and head", "")
            assert state["delay_ms"] == 0
            async with http.post(f"{gateway.page}senders", json={"delay_ms": 90}) as answer:
                assert [each["delay_ms"] for each in (await answer.json())["senders"]] == [90]
            async with http.post(f"{gateway.page}senders", json={"stop": url}) as answer:
                assert await answer.json() == {"senders": [], "stopped": []}

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        asyncio.run(look(program))


def time_sent(program: socket.socket) -> float:
    """Return the time in the next frame, whose first message that is."""
    while (first := next(iter(OscBundle(program.recv(2000))))).address != "/kouxing/time":
        pass
    return round(float(first.params[0]), 3)


def test_sigterm_closes_with_a_reason_and_exits_0(own_gateway: GatewayProcess) -> None:
    gateway = own_gateway

    async def look() -> int | None:
        async with (
            aiohttp.ClientSession() as http,
            http.ws_connect(f"{gateway.page}viewer") as browser,
        ):
            await receive_json(browser, "status")
            gateway.process.send_signal(signal.SIGTERM)
            with pytest.raises(EOFError):
                await receive_json(browser, "never")
            return browser.close_code

    assert asyncio.run(look()) == aiohttp.WSCloseCode.GOING_AWAY
    assert gateway.process.wait(60) == 0


def test_an_address_that_cannot_be_had_is_a_users_mistake() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
        taken = spawn(KOUXING_GATEWAY_PORT=port)
        strange = spawn(KOUXING_GATEWAY_HOST="192.0.2.1", KOUXING_GATEWAY_INSECURE="1")
        for process, words in (
            (taken, f"gateway.port: {port} is in use"),
            (strange, "gateway.host"),
        ):
            _, text = process.communicate(timeout=60)
            assert process.returncode == 2
            assert words in text
            assert "Traceback" not in text
