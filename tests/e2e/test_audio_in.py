"""Audio from WebRTC clients, and malformed messages, against real services."""

import asyncio
import contextlib
import difflib
import json
from collections.abc import Callable, Coroutine
from random import Random

import aiohttp
import aioice
import numpy as np
import pytest
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.contrib.media import MediaPlayer
from aiortc.rtcdtlstransport import RTCDtlsTransport

from kouxing.services.gateway.wire import FAP_TYPE, SHAPES_TYPE
from kouxing.shared.face.shapes import ARKIT
from kouxing.shared.phones.inventory import load_inventory
from tests.e2e.following import samples_of_file, stream
from tests.raw_bytes import pour
from tests.system import DEMO, LIMIT_S, System, port_of

SDP = "application/sdp"
OPEN_JAW = 2  # index of FAP 3
SPEECH = DEMO / "lake-male.wav"
Send = Callable[[RTCDtlsTransport, bytes], Coroutine[None, None, None]]


@pytest.fixture(scope="module")
def expected(system: System) -> list[str]:
    """The phones of the recording, without pauses."""
    return without_silence(stream(system.control, samples_of_file(SPEECH)).symbols)


def without_silence(symbols: list[str]) -> list[str]:
    return [symbol for symbol in symbols if symbol != load_inventory().silence]


def with_loss(send: Send, share_lost: float) -> Send:
    """Return a send function that drops a share of the packets, the same ones in every run."""
    random = Random(0)  # noqa: S311 - not for cryptography

    async def send_most(transport: RTCDtlsTransport, packet: bytes) -> None:
        if random.random() >= share_lost:
            await send(transport, packet)

    return send_most


def test_webrtc_streams_sound_and_returns_frames_despite_lost_packets(
    system: System, expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: ["127.0.0.1"])
    monkeypatch.setattr(RTCDtlsTransport, "_send_rtp", with_loss(RTCDtlsTransport._send_rtp, 0.05))
    opening = {FAP_TYPE: 0.0, SHAPES_TYPE: 0.0}  # largest opening of the jaw, in both formats
    index = {FAP_TYPE: OPEN_JAW, SHAPES_TYPE: ARKIT.names.index("jawOpen")}
    phones: dict[int, str] = {}

    def receive(message: str | bytes) -> None:
        if isinstance(message, bytes):
            if (kind := message[0]) in opening:
                value = float(np.frombuffer(message, "<f4", offset=16)[index[kind]])
                opening[kind] = max(opening[kind], value)
        elif (fields := json.loads(message))["type"] == "phone":
            phones[fields["index"]] = fields["symbol"]

    async def call() -> None:
        peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        track = MediaPlayer(str(SPEECH)).audio
        assert track is not None
        peer.addTrack(track)
        peer.createDataChannel("face").on("message", receive)
        await peer.setLocalDescription(await peer.createOffer())
        url, headers = f"{system.page}whip?shapes=arkit", {"Content-Type": SDP}
        async with (
            aiohttp.ClientSession() as http,
            http.post(url, data=peer.localDescription.sdp, headers=headers) as answer,
        ):
            assert answer.status == 201
            sdp = await answer.text()
            hosts = {line.split()[4] for line in sdp.splitlines() if "a=candidate" in line}
            assert hosts == {"127.0.0.1"}
            await peer.setRemoteDescription(RTCSessionDescription(sdp, "answer"))
            async with asyncio.timeout(LIMIT_S):
                # On a busy machine, frames arrive later than their phones.
                while len(phones) < len(expected) / 2 or opening[FAP_TYPE] < 200:
                    await asyncio.sleep(0.05)
            resource = system.page.rstrip("/") + answer.headers["Location"]
            async with http.delete(resource) as deleted:
                assert deleted.status == 200
        await peer.close()

    asyncio.run(call())
    received = without_silence([phones[index] for index in sorted(phones)])
    similarity = difflib.SequenceMatcher(None, received, expected[: len(received)]).ratio()
    assert similarity > 0.4
    assert opening[SHAPES_TYPE] > 0.2


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
    system: System, body: str | bytes, content_type: str, status: int, text: str
) -> None:
    async def post() -> None:
        headers = {"Content-Type": content_type}
        async with (
            aiohttp.ClientSession() as http,
            http.post(f"{system.page}whip", data=body, headers=headers) as answer,
        ):
            assert (answer.status, text in await answer.text()) == (status, True)

    asyncio.run(post())


MALFORMED: list[str | bytes] = [
    "", "{", "null", "[]", "5", '"x"', '{"type": "x"}', '{"a":' * 1000, "\0", "人" * 1000,
    '{"sample_rate_hz": "x"}', '{"encoding": []}', '{"session": {}}', '{"lips": 1}',
    '{"flush": "x"}', '{"express": {"joy": NaN}}', '{"mouth_profile": "%%"}', '{"eof": 1}',
    b"", b"\0", b"\xff" * 7, bytes(20_000), b"RIFF" + bytes(60),
]  # fmt: skip


def test_malformed_messages_do_not_disturb_other_clients(
    system: System, expected: list[str]
) -> None:
    random = Random(0)  # noqa: S311 - not for cryptography

    async def send_malformed(http: aiohttp.ClientSession, path: str) -> None:
        for _ in range(10):
            with contextlib.suppress(aiohttp.ClientError, TimeoutError):
                async with http.ws_connect(f"{system.page}{path}") as client:
                    for _ in range(random.choice([1, 3, 10])):
                        message = random.choice(MALFORMED)
                        send = client.send_str if isinstance(message, str) else client.send_bytes
                        await send(message)  # type: ignore[arg-type]
                    await client.receive(0.2)

    async def speak(http: aiohttp.ClientSession) -> list[str]:
        phones: dict[int, str] = {}
        pcm = (samples_of_file(SPEECH) * 32767).astype("<i2").tobytes()
        async with http.ws_connect(f"{system.page}microphone") as microphone:
            await microphone.send_json({"sample_rate_hz": 16000, "ahead": True})
            session = (await microphone.receive_json(timeout=LIMIT_S))["session"]
            async with http.ws_connect(f"{system.page}viewer?session={session}") as viewer:
                await microphone.send_bytes(pcm)
                await microphone.send_str('{"eof": 1}')
                async with asyncio.timeout(LIMIT_S):
                    async for message in viewer:
                        text = message.type is aiohttp.WSMsgType.TEXT
                        fields = json.loads(message.data) if text else {}
                        if fields.get("type") == "phone":
                            phones[fields["index"]] = fields["symbol"]
                        if fields.get("type") == "end":
                            break
        return without_silence([phones[index] for index in sorted(phones)])

    async def wait_for_room(http: aiohttp.ClientSession) -> None:
        """Return when the earlier connections have left room for a few more."""
        viewer = f"{system.page}viewer"
        async with asyncio.timeout(LIMIT_S):
            while True:
                with contextlib.suppress(aiohttp.ClientError):
                    async with (
                        http.ws_connect(viewer),
                        http.ws_connect(viewer),
                        http.ws_connect(viewer),
                        http.ws_connect(viewer),
                    ):
                        return
                await asyncio.sleep(0.1)

    async def run() -> list[str]:
        async with aiohttp.ClientSession() as http:
            for path in ("viewer", "microphone"):
                await send_malformed(http, path)
            await wait_for_room(http)
            return await speak(http)

    pour(port_of(system.page), 0.5)
    spoken = asyncio.run(run())
    system.assert_all_alive()
    assert difflib.SequenceMatcher(None, spoken, expected).ratio() > 0.8
