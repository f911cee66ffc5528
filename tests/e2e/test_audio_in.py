"""Audio from WebRTC clients, against real services."""

import asyncio
import difflib
import json
import re
from collections.abc import Callable, Collection, Coroutine
from fractions import Fraction
from random import Random

import aiohttp
import aioice
import numpy as np
import pytest
from aiortc import (
    MediaStreamTrack,
    RTCConfiguration,
    RTCPeerConnection,
    RTCRtpSender,
    RTCSessionDescription,
)
from aiortc.contrib.media import MediaPlayer
from aiortc.rtcdtlstransport import RTCDtlsTransport
from av import AudioFrame

from kouxing.services.gateway.messages.browser_messages import FAP_TYPE, SHAPES_TYPE
from kouxing.services.gateway.webrtc.connection import WebRtcPeer
from kouxing.shared.face.shapes import ARKIT
from kouxing.shared.phones.inventory import load_inventory
from tests.e2e.streaming import stream_audio
from tests.system import CHAIN, DEMO, LIMIT_S, System, samples_of_file

SDP = "application/sdp"
RTP_UNIT = Fraction(1, 48_000)
OPEN_JAW = 2  # index of FAP 3
SPEECH = DEMO / "lake-male.wav"
Send = Callable[[RTCDtlsTransport, bytes], Coroutine[None, None, None]]


@pytest.fixture(scope="module")
def services() -> Collection[str]:
    return (*CHAIN, "gateway")


@pytest.fixture(scope="module")
def expected_phones(system: System) -> list[str]:
    """The phones of the recording, without pauses."""
    return without_silence(stream_audio(system.control, samples_of_file(SPEECH)).symbols)


def without_silence(symbols: list[str]) -> list[str]:
    return [symbol for symbol in symbols if symbol != load_inventory().silence]


def lossy_send(send: Send, loss_fraction: float) -> Send:
    """Return a send function that drops a fraction of the packets, the same ones in every run."""
    random = Random(0)  # noqa: S311 - not for cryptography

    async def send_or_drop(transport: RTCDtlsTransport, packet: bytes) -> None:
        if random.random() >= loss_fraction:
            await send(transport, packet)

    return send_or_drop


def test_webrtc_streams_sound_and_returns_frames_despite_lost_packets(
    system: System, expected_phones: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: ["127.0.0.1"])
    monkeypatch.setattr(RTCDtlsTransport, "_send_rtp", lossy_send(RTCDtlsTransport._send_rtp, 0.05))
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
                while len(phones) < len(expected_phones) / 2 or opening[FAP_TYPE] < 200:
                    await asyncio.sleep(0.05)
            resource = system.page.rstrip("/") + answer.headers["Location"]
            async with http.delete(resource) as deleted:
                assert deleted.status == 200
        await peer.close()

    asyncio.run(call())
    received = without_silence([phones[index] for index in sorted(phones)])
    similarity = difflib.SequenceMatcher(None, received, expected_phones[: len(received)]).ratio()
    assert similarity > 0.4
    assert opening[SHAPES_TYPE] > 0.2


async def post_offer(page: str, body: str | bytes, content_type: str = SDP) -> tuple[int, str]:
    """Return the status and the text of the answer to an offer; the session is closed again."""
    headers = {"Content-Type": content_type}
    async with (
        aiohttp.ClientSession() as http,
        http.post(f"{page}whip", data=body, headers=headers) as answer,
    ):
        if answer.status == 201:
            await http.delete(page.rstrip("/") + answer.headers["Location"])
        return answer.status, await answer.text()


@pytest.mark.parametrize(
    ("body", "content_type", "status", "text"),
    [
        ("{}", "application/json", 415, "expected an SDP offer (application/sdp)"),
        ("hello", SDP, 422, "expected"),
        ("v=0\r\n", SDP, 422, "an audio track in Opus"),
        ("v=0\r\nm=audio x\r\na=rtpmap:96 opus/48000/2", SDP, 422, "cannot answer this SDP offer"),
        (b"\xff\xfe", SDP, 422, "expected"),
    ],
)
def test_whip_rejects_bodies_that_are_not_opus_offers(
    system: System, body: str | bytes, content_type: str, status: int, text: str
) -> None:
    answered = asyncio.run(post_offer(system.page, body, content_type))
    assert answered[0] == status
    assert text in answered[1]


@pytest.mark.parametrize(
    ("codecs", "status", "answered"),
    [(["PCMU", "opus"], 201, {"opus/48000/2"}), (["PCMU"], 422, set())],
)
def test_whip_answers_with_opus_even_if_the_client_prefers_another_codec(
    system: System, codecs: list[str], status: int, answered: set[str]
) -> None:
    async def post() -> tuple[int, str]:
        offered = {codec.mimeType: codec for codec in RTCRtpSender.getCapabilities("audio").codecs}
        peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        peer.addTransceiver("audio").setCodecPreferences(
            [offered[f"audio/{name}"] for name in codecs]
        )
        await peer.setLocalDescription(await peer.createOffer())
        answer = await post_offer(system.page, peer.localDescription.sdp)
        await peer.close()
        return answer

    received_status, text = asyncio.run(post())
    assert received_status == status
    assert set(re.findall(r"^a=rtpmap:\d+ (\S+)", text, re.MULTILINE)) == answered


class _SpeechThenNothing(MediaStreamTrack):
    """Silence, a loud end, and then no packets, like a client that does not transmit pauses."""

    kind = "audio"

    def __init__(self) -> None:
        super().__init__()
        self._num_frames = 0

    async def recv(self) -> AudioFrame:
        if self._num_frames == 30:
            await asyncio.Event().wait()
        samples = np.zeros((1, 960), np.int16)
        if self._num_frames >= 28:
            samples[:] = 20_000 * np.sin(np.arange(960) / 20)
        frame = AudioFrame.from_ndarray(samples, format="s16", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = 48_000, self._num_frames * 960, RTP_UNIT
        self._num_frames += 1
        return frame


def test_the_end_of_speech_arrives_although_no_packet_follows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: ["127.0.0.1"])

    async def call() -> None:
        client = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        client.addTrack(_SpeechThenNothing())
        await client.setLocalDescription(await client.createOffer())
        gateway = WebRtcPeer(lambda _: None)
        answer = await gateway.answer(client.localDescription.sdp)
        await client.setRemoteDescription(RTCSessionDescription(answer, "answer"))
        async with asyncio.timeout(LIMIT_S):
            async for _, pcm, _ in gateway.receive_audio():
                if np.frombuffer(pcm, "<i2").max() > 5_000:
                    break
            else:
                pytest.fail("the connection has ended")
        await gateway.close()
        await client.close()

    asyncio.run(call())
