"""Audio from WebRTC clients, and malformed messages, against real services."""

from __future__ import annotations

import asyncio
import contextlib
import difflib
import json
import socket
from collections.abc import Callable, Coroutine, Iterator
from random import Random
from urllib.parse import urlsplit

import aiohttp
import aioice
import numpy as np
import pytest
import websockets
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.contrib.media import MediaPlayer
from aiortc.rtcdtlstransport import RTCDtlsTransport

from kouxing.evaluation.system.chromium import wait_until
from kouxing.services.gateway.wire import FAP_TYPE, SHAPES_TYPE
from kouxing.shared.face.shapes import ARKIT
from kouxing.shared.phones.inventory import load_inventory
from tests.e2e.following import samples_of_file, stream
from tests.raw_bytes import pour
from tests.scripted_system import Gateway
from tests.system import DEMO, System, free_port

pytestmark = pytest.mark.e2e

SDP = "application/sdp"
OPEN_JAW = 2  # index of FAP 3
SPEECH = DEMO / "lake-male.wav"
Send = Callable[[RTCDtlsTransport, bytes], Coroutine[None, None, None]]


@pytest.fixture(scope="module")
def gateway(system: System) -> Iterator[Gateway]:
    gateway = Gateway(system.control, free_port())
    address = urlsplit(gateway.page)
    wait_until(lambda: is_open(str(address.hostname), address.port or 0), 60)
    yield gateway
    assert gateway.stop() == 0


def is_open(host: str, port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((host, port)) == 0


@pytest.fixture(scope="module")
def expected(system: System) -> list[str]:
    """The phones of the recording, without pauses."""
    silence = load_inventory().silence
    symbols = stream(system.control, samples_of_file(SPEECH)).symbols
    return [symbol for symbol in symbols if symbol != silence]


def with_loss(send: Send, share_lost: float) -> Send:
    """Return a send function that drops a share of the packets, the same ones in every run."""
    random = Random(0)  # noqa: S311 - not for cryptography

    async def send_most(transport: RTCDtlsTransport, packet: bytes) -> None:
        if random.random() >= share_lost:
            await send(transport, packet)

    return send_most


async def make_offer(peer: RTCPeerConnection) -> str:
    await peer.setLocalDescription(await peer.createOffer())
    return peer.localDescription.sdp


@pytest.mark.parametrize(("share_lost", "min_similarity"), [(0.0, 0.5), (0.05, 0.4)])
def test_webrtc_streams_sound_and_returns_frames(
    system: System,
    gateway: Gateway,
    expected: list[str],
    monkeypatch: pytest.MonkeyPatch,
    share_lost: float,
    min_similarity: float,
) -> None:
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: ["127.0.0.1"])
    monkeypatch.setattr(
        RTCDtlsTransport, "_send_rtp", with_loss(RTCDtlsTransport._send_rtp, share_lost)
    )
    faces: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    phones: dict[int, str] = {}
    num_gaps_before = system.num_gaps()

    def receive(message: str | bytes) -> None:
        if isinstance(message, bytes):
            values = np.frombuffer(message, "<f4", offset=16)
            if message[0] == FAP_TYPE:
                faces.append(values)
            elif message[0] == SHAPES_TYPE:
                weights.append(values)
        elif (fields := json.loads(message))["type"] == "phone":
            phones[fields["index"]] = fields["symbol"]

    async def call() -> None:
        peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        track = MediaPlayer(str(SPEECH)).audio
        assert track is not None
        peer.addTrack(track)
        peer.createDataChannel("face").on("message", receive)
        url, headers = f"{gateway.page}whip?shapes=arkit", {"Content-Type": SDP}
        async with (
            aiohttp.ClientSession() as http,
            http.post(url, data=await make_offer(peer), headers=headers) as answer,
        ):
            assert answer.status == 201
            sdp = await answer.text()
            hosts = {line.split()[4] for line in sdp.splitlines() if "a=candidate" in line}
            assert hosts == {"127.0.0.1"}
            await peer.setRemoteDescription(RTCSessionDescription(sdp, "answer"))
            async with asyncio.timeout(60):
                while len(phones) < len(expected) / 2:
                    await asyncio.sleep(0.05)
            resource = gateway.page.rstrip("/") + answer.headers["Location"]
            async with http.delete(resource) as deleted:
                assert deleted.status == 200
        await peer.close()

    asyncio.run(call())
    silence = load_inventory().silence
    received = [phones[index] for index in sorted(phones) if phones[index] != silence]
    similarity = difflib.SequenceMatcher(None, received, expected[: len(received)]).ratio()
    assert similarity > min_similarity
    assert system.num_gaps() == num_gaps_before
    assert max(face[OPEN_JAW] for face in faces) > 50
    assert max(frame[ARKIT.names.index("jawOpen")] for frame in weights) > 0.1


@pytest.mark.parametrize(
    ("body", "content_type", "status", "text"),
    [
        ("{}", "application/json", 415, "expected an SDP offer (application/sdp)"),
        ("hello", SDP, 422, "expected"),
        ("v=0\r\n", SDP, 422, "an audio track in Opus"),
        ("v=0\r\nm=audio x", SDP, 422, "cannot answer this SDP offer"),
        (b"\xff\xfe", SDP, 422, "expected"),
    ],
)
def test_whip_rejects_bodies_that_are_not_opus_offers(
    gateway: Gateway, body: str | bytes, content_type: str, status: int, text: str
) -> None:
    async def post() -> None:
        headers = {"Content-Type": content_type}
        async with (
            aiohttp.ClientSession() as http,
            http.post(f"{gateway.page}whip", data=body, headers=headers) as answer,
        ):
            assert (answer.status, text in await answer.text()) == (status, True)

    asyncio.run(post())


MALFORMED: list[str | bytes] = [
    "", "{", "null", "[]", "5", '"x"', '{"type": "x"}', '{"a":' * 1000, "\0", "人" * 1000,
    '{"sample_rate_hz": "x"}', '{"encoding": []}', '{"session": {}}', '{"lips": 1}',
    '{"flush": "x"}', '{"express": {"joy": NaN}}', '{"mouth_profile": "%%"}', '{"eof": 1}',
    b"", b"\0", b"\xff" * 7, bytes(20_000), b"RIFF" + bytes(60),
]  # fmt: skip


@pytest.mark.parametrize("path", ["viewer", "microphone"])
def test_malformed_messages_do_not_disturb_other_clients(
    gateway: Gateway, expected: list[str], path: str
) -> None:
    random = Random(path)  # noqa: S311 - not for cryptography
    url = f"{gateway.page}{path}".replace("http", "ws")

    async def send_malformed() -> None:
        for _ in range(20):
            with contextlib.suppress(websockets.WebSocketException, TimeoutError):
                async with asyncio.timeout(1), websockets.connect(url, close_timeout=1) as client:
                    for _ in range(random.choice([1, 3, 10])):
                        await client.send(random.choice(MALFORMED))
                    await client.recv()

    async def wait_for_room() -> None:
        """Return when the poured connections have left room for another one."""
        async with asyncio.timeout(60):
            while True:
                with contextlib.suppress(websockets.WebSocketException, OSError):
                    async with websockets.connect(f"{gateway.page}viewer".replace("http", "ws")):
                        return
                await asyncio.sleep(0.1)

    async def speak() -> list[str]:
        phones: dict[int, str] = {}
        page = gateway.page.replace("http", "ws")
        hello = {"sample_rate_hz": 16000, "ahead": True}
        pcm = (samples_of_file(SPEECH) * 32767).astype("<i2").tobytes()
        async with websockets.connect(f"{page}microphone") as microphone:
            await microphone.send(json.dumps(hello))
            session = json.loads(await microphone.recv())["session"]
            async with websockets.connect(f"{page}viewer?session={session}") as viewer:
                await microphone.send(pcm)
                await microphone.send('{"eof": 1}')
                async with asyncio.timeout(60):
                    async for message in viewer:
                        fields = json.loads(message) if isinstance(message, str) else {}
                        if fields.get("type") == "phone":
                            phones[fields["index"]] = fields["symbol"]
                        if fields.get("type") == "end":
                            break
        silence = load_inventory().silence
        return [phones[index] for index in sorted(phones) if phones[index] != silence]

    pour(int(urlsplit(gateway.page).port or 0), 0.5)
    asyncio.run(send_malformed())
    assert gateway.process.poll() is None
    asyncio.run(wait_for_room())
    spoken = asyncio.run(speak())
    assert difflib.SequenceMatcher(None, spoken, expected).ratio() > 0.8
