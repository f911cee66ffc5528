"""Sound from other programs' protocols, through the gateway into real services."""

from __future__ import annotations

import asyncio
import contextlib
import difflib
import json
import socket
import subprocess
import sys
import wave
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from random import Random
from typing import Any
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
from tests.documents import code_blocks
from tests.e2e.following import samples_of_file, stream
from tests.raw_bytes import pour
from tests.scripted_system import Gateway
from tests.system import DEMO, ROOT, System, free_port

pytestmark = pytest.mark.e2e

SDP = "application/sdp"
OPEN_JAW = 2  # index of FAP 3
SPOKEN = DEMO / "lake-male.wav"
VOSK_PAGE = ROOT / "docs" / "clients" / "vosk.md"
Send = Callable[[RTCDtlsTransport, bytes], Coroutine[None, None, None]]
Socket = websockets.ClientConnection  # of the library that the clients of vosk-server use


@pytest.fixture(scope="module")
def vosk_port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def gateway(system: System, vosk_port: int) -> Iterator[Gateway]:
    gateway = Gateway(system.control, free_port(), vosk_port=str(vosk_port))
    wait_until(lambda: is_answered(gateway.page), 60)
    yield gateway
    assert gateway.stop() == 0


@pytest.fixture(scope="module")
def expected(system: System) -> list[str]:
    """The phones of the recording, without its pauses."""
    silence = load_inventory().silence
    symbols = stream(system.control, samples_of_file(SPOKEN)).symbols
    return [symbol for symbol in symbols if symbol != silence]


def is_answered(page: str) -> bool:
    address = urlsplit(page)
    with socket.socket() as probe:
        return probe.connect_ex((str(address.hostname), address.port or 0)) == 0


async def ask(client: Socket, message: str | bytes) -> dict[str, Any]:
    """Send a message and return its reply, as the clients of vosk-server do."""
    await client.send(message)
    async with asyncio.timeout(60):
        return dict(json.loads(await client.recv()))


def connect(url: str, converse: Callable[[Socket], Coroutine[None, None, None]]) -> None:
    async def run() -> None:
        async with websockets.connect(url) as client:
            await converse(client)

    asyncio.run(run())


def words_of(replies: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [word for reply in replies for word in reply.get("result", ())]


def test_a_client_of_vosk_server_gets_the_phones_in_its_shape(
    gateway: Gateway, vosk_port: int, expected: list[str]
) -> None:
    replies: list[dict[str, Any]] = []

    async def recognize(client: Socket) -> None:
        with wave.open(str(SPOKEN)) as file:
            rate_hz = file.getframerate()
            await client.send('{ "config" : { "sample_rate" : %d } }' % rate_hz)  # noqa: UP031
            while data := file.readframes(int(rate_hz * 0.2)):
                replies.append(await ask(client, data))
        replies.append(await ask(client, '{"eof" : 1}'))
        await asyncio.wait_for(client.wait_closed(), 60)
        assert client.close_code == aiohttp.WSCloseCode.OK

    connect(f"ws://localhost:{vosk_port}", recognize)
    assert len(replies) == 19
    assert all(reply.keys() in ({"partial"}, {"result", "text"}) for reply in replies[:-1])
    words = words_of(replies)
    assert [word["word"] for word in words] == expected
    assert " ".join(reply["text"] for reply in replies if "text" in reply).split() == expected
    assert all(word.keys() == {"word", "start", "end", "conf"} for word in words)
    times = [time for word in words for time in (word["start"], word["end"])]
    assert times == sorted(times)
    assert 0 < times[0] < times[-1] < 3.6


def test_a_whole_wav_file_needs_no_config(gateway: Gateway, expected: list[str]) -> None:
    replies: list[dict[str, Any]] = []

    async def recognize(client: Socket) -> None:
        with SPOKEN.open("rb") as file:  # its header, too
            while data := file.read(8000):
                replies.append(await ask(client, data))
        replies.append(await ask(client, '{"eof" : 1}'))

    connect(f"{gateway.page}vosk".replace("http", "ws"), recognize)
    assert [word["word"] for word in words_of(replies)] == expected


def test_a_client_may_say_what_is_not_known_here_and_ask_for_results(
    gateway: Gateway, vosk_port: int, expected: list[str]
) -> None:
    replies: list[dict[str, Any]] = []
    config = {"phrase_list": ["ni hao"], "sample_rate": 16000.0, "words": 0}

    async def recognize(client: Socket) -> None:
        await client.send(json.dumps({"config": config}))
        assert await ask(client, '{"reset" : 1}') == {"text": ""}
        assert await ask(client, '{"flush" : 1}') == {"partial": ""}
        with wave.open(str(SPOKEN)) as file:
            while data := file.readframes(4000):
                replies.append(await ask(client, data))
                if len(replies) == 8:
                    replies.append(await ask(client, '{"reset" : 1}'))
        replies.append(await ask(client, '{"eof" : 1}'))

    connect(f"ws://localhost:{vosk_port}", recognize)
    assert replies[8].keys() == {"text"}
    assert all("result" not in reply for reply in replies)
    symbols = " ".join(reply.get("text", "") for reply in replies).split()
    # the phone that was under way may have been told as it was not in the end
    assert difflib.SequenceMatcher(None, symbols, expected).ratio() > 0.9


def test_the_program_of_the_documents_prints_what_is_recognized(
    gateway: Gateway, vosk_port: int, expected: list[str], tmp_path: Path
) -> None:
    (code,) = code_blocks(VOSK_PAGE, "python")
    program = tmp_path / "test.py"
    program.write_text(code.replace(":2700", f":{vosk_port}"), "utf-8")
    command = [sys.executable, str(program), str(SPOKEN)]
    printed = subprocess.check_output(command, timeout=60, text=True)
    replies = [json.loads(line) for line in printed.splitlines()]
    assert [word["word"] for word in words_of(replies)] == expected


def test_speech_that_is_synthesized_ahead_can_be_interrupted(
    gateway: Gateway, expected: list[str]
) -> None:
    replies: list[dict[str, Any]] = []
    pcm = (samples_of_file(SPOKEN) * 32767).astype("<i2").tobytes()

    async def speak(client: Socket) -> None:
        await client.send('{"config": {"sample_rate": 16000, "ahead": true}}')
        for _ in range(7):  # 25 s
            replies.append(await ask(client, pcm))
        replies.append(await ask(client, '{"flush": 1}'))
        replies.append(await ask(client, pcm))
        replies.append(await ask(client, '{"eof" : 1}'))

    connect(f"{gateway.page}vosk".replace("http", "ws"), speak)
    symbols = [word["word"] for word in words_of(replies)]
    assert len(symbols) < 5 * len(expected)
    spoken_last = symbols[-len(expected) :]  # recognised a little otherwise after the cut
    assert difflib.SequenceMatcher(None, spoken_last, expected).ratio() > 0.8


def test_sound_in_a_wrong_format_is_an_error_and_the_end(gateway: Gateway) -> None:
    async def send(client: Socket) -> None:
        await client.send('{"config": {"sample_rate": 0}}')
        reply = await ask(client, bytes(640))
        assert "sample_rate_hz must be a whole number of 8000 to 48000, not 0" in reply["error"]
        await asyncio.wait_for(client.wait_closed(), 60)
        assert client.close_code == aiohttp.WSCloseCode.UNSUPPORTED_DATA

    connect(f"{gateway.page}vosk".replace("http", "ws"), send)


def losing(send: Send, share_lost: float) -> Send:
    """Return what sends packets but a share, the same ones every time."""
    random = Random(0)  # noqa: S311 - the same every time

    async def send_most(transport: RTCDtlsTransport, packet: bytes) -> None:
        if random.random() >= share_lost:
            await send(transport, packet)

    return send_most


async def offer(peer: RTCPeerConnection) -> str:
    await peer.setLocalDescription(await peer.createOffer())
    return peer.localDescription.sdp


@pytest.mark.parametrize(("share_lost", "alike"), [(0.0, 0.5), (0.05, 0.4)])
def test_webrtc_brings_sound_and_takes_frames_back(
    system: System,
    gateway: Gateway,
    expected: list[str],
    monkeypatch: pytest.MonkeyPatch,
    share_lost: float,
    alike: float,
) -> None:
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: ["127.0.0.1"])
    monkeypatch.setattr(
        RTCDtlsTransport, "_send_rtp", losing(RTCDtlsTransport._send_rtp, share_lost)
    )
    faces: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    phones: dict[int, str] = {}
    before = system.num_gaps()

    def receive(message: str | bytes) -> None:
        if isinstance(message, bytes):
            values = np.frombuffer(message, "<f4", offset=16)
            if message[0] == FAP_TYPE:
                faces.append(values)
            elif message[0] == SHAPES_TYPE:
                weights.append(values)
        elif (told := json.loads(message))["type"] == "phone":
            phones[told["index"]] = told["symbol"]

    async def call() -> None:
        peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        track = MediaPlayer(str(SPOKEN)).audio
        assert track is not None
        peer.addTrack(track)
        peer.createDataChannel("face").on("message", receive)
        url, headers = f"{gateway.page}whip?shapes=arkit", {"Content-Type": SDP}
        async with (
            aiohttp.ClientSession() as http,
            http.post(url, data=await offer(peer), headers=headers) as answer,
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
            async with http.delete(resource) as ended:
                assert ended.status == 200
        await peer.close()

    asyncio.run(call())
    silence = load_inventory().silence
    heard = [phones[index] for index in sorted(phones) if phones[index] != silence]
    assert difflib.SequenceMatcher(None, heard, expected[: len(heard)]).ratio() > alike
    assert system.num_gaps() == before
    assert max(face[OPEN_JAW] for face in faces) > 100
    assert max(each[ARKIT.names.index("jawOpen")] for each in weights) > 0.1


@pytest.mark.parametrize(
    ("body", "kind", "status", "told"),
    [
        ("{}", "application/json", 415, "expected an SDP offer (application/sdp)"),
        ("hello", SDP, 422, "expected"),
        ("v=0\r\n", SDP, 422, "an audio track in Opus"),
        ("v=0\r\nm=audio x", SDP, 422, "expected an SDP offer"),
        (b"\xff\xfe", SDP, 422, "expected"),
    ],
)
def test_what_is_no_offer_of_opus_is_refused(
    gateway: Gateway, body: str | bytes, kind: str, status: int, told: str
) -> None:
    async def post() -> None:
        headers = {"Content-Type": kind}
        async with (
            aiohttp.ClientSession() as http,
            http.post(f"{gateway.page}whip", data=body, headers=headers) as answer,
        ):
            assert (answer.status, told in await answer.text()) == (status, True)

    asyncio.run(post())


NONSENSE: list[str | bytes] = [
    "", "{", "null", "[]", "5", '"x"', '{"type": "x"}', '{"a":' * 1000, "\0", "人" * 1000,
    '{"config": 5}', '{"config": {"sample_rate": "x"}}', '{"config": {"sample_rate": -1}}',
    '{"config": {"encoding": []}}', '{"session": {}}', '{"lips": 1}', '{"flush": "x"}',
    '{"reset": 0}', '{"expressions": {"joy": NaN}}', '{"voice": "%%"}', '{"eof": 1}',
    b"", b"\0", b"\xff" * 7, bytes(20_000), b"RIFF" + bytes(60),
]  # fmt: skip


@pytest.mark.parametrize("path", ["viewer", "microphone", "vosk"])
def test_nonsense_at_the_gateway_harms_nobody(
    gateway: Gateway, vosk_port: int, expected: list[str], path: str
) -> None:
    random = Random(path)  # noqa: S311 - the same every time
    url = f"{gateway.page}{path}".replace("http", "ws")

    async def talk() -> None:
        for _ in range(20):
            with contextlib.suppress(websockets.WebSocketException, TimeoutError):
                async with asyncio.timeout(1), websockets.connect(url, close_timeout=1) as client:
                    for _ in range(random.choice([1, 3, 10])):
                        await client.send(random.choice(NONSENSE))
                    await client.recv()

    for port in (int(urlsplit(gateway.page).port or 0), vosk_port):
        pour(port, 0.5)
    asyncio.run(talk())
    assert gateway.process.poll() is None
    replies: list[dict[str, Any]] = []

    async def recognize(client: Socket) -> None:
        with SPOKEN.open("rb") as file:
            while data := file.read(8000):
                replies.append(await ask(client, data))
        replies.append(await ask(client, '{"eof" : 1}'))

    if path == "vosk":  # once for all: the others' sessions have ended
        connect(url, recognize)
        assert [word["word"] for word in words_of(replies)] == expected
