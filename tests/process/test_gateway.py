"""The gateway's WebSockets, between a scripted control and clients."""

import json
import socket
import struct
from collections.abc import Iterator

import aiohttp
import msgpack
import numpy as np
import pytest
from pythonosc.osc_bundle import OscBundle

from kouxing.services.gateway.audio.microphone_handler import MAX_MESSAGE_BYTES
from kouxing.services.gateway.messages.browser_messages import (
    FAP_TYPE,
    REST_SHAPES_TYPE,
    REST_TYPE,
    SHAPES_TYPE,
)
from kouxing.shared.face.faps import FAP_NUMBER
from kouxing.shared.face.shapes import VRM
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.speech import Acoustic
from tests.fake_control import EPOCH, FakeControl
from tests.process.web_clients import (
    FACE,
    async_test,
    open_websockets,
    publish_all,
    receive_binary,
    receive_json,
    receive_session_message,
    wait_until_async,
)
from tests.raw_bytes import flood
from tests.samples import fap_frame
from tests.system import LIMIT_S, Gateway, port_of

PONG = b"\x8a\x80" + bytes(4)  # of a client


@pytest.fixture(scope="module")
def shared_control() -> Iterator[FakeControl]:
    with FakeControl() as control:
        yield control


@pytest.fixture(scope="module")
def gateway(shared_control: FakeControl) -> Iterator[Gateway]:
    gateway = Gateway(shared_control.address)
    assert shared_control.page == gateway.page
    yield gateway
    assert gateway.stop() == 0


@pytest.fixture
def control(shared_control: FakeControl) -> FakeControl:
    """The control of the module, without the records of earlier tests."""
    shared_control.clear()
    return shared_control


# --- viewers


def media_time_of(message: bytes) -> float:
    return float(struct.unpack_from("<d", message, 8)[0])


def connect_with_small_buffer(page: str, path: str) -> socket.socket:
    """Open a WebSocket for a client that reads later."""
    client = socket.socket()
    client.settimeout(LIMIT_S)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.connect(("127.0.0.1", port_of(page)))
    lines = (
        f"GET /{path} HTTP/1.1",
        f"Host: 127.0.0.1:{port_of(page)}",
        *("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"),
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
    )
    client.sendall("\r\n".join([*lines, "", ""]).encode())
    return client


@async_test
async def test_viewers_receive_their_session(control: FakeControl, gateway: Gateway) -> None:
    async with open_websockets(gateway.page, "viewer", "viewer?session=other") as (newest, other):
        await receive_json(newest, "status", missing=[])
        control.start("one")
        publish_all(control, "one")
        shown = {"session": "one", "lip_model": "dynamic-visemes", "language": "zh"}
        size = {"expressiveness": 1.0, "feeling": None}
        await receive_json(newest, "session", **shown, **size, sample=False)
        messages = [await receive_session_message(newest) for _ in range(5)]
        binary = {m.data[0]: m.data for m in messages if m.type is aiohttp.WSMsgType.BINARY}
        texts = [json.loads(m.data) for m in messages if m.type is aiohttp.WSMsgType.TEXT]
        assert struct.unpack_from("<B3xId", binary[1]) == (1, EPOCH, 320.0)
        assert binary[1][16:] == FACE
        assert binary[2][16:] == b"\x01\x00\xff\x7f"
        symbols = {text["type"]: text.get("symbol") for text in texts}
        assert symbols == {"speech": None, "phone": "iao", "syllable": "yao"}
        control.publish(control.phones, Acoustic(session="one", epoch=EPOCH, model="light"))
        await receive_json(newest, "acoustic", acoustic="light")
        await newest.send_json({"acoustic": "full"})
        await wait_until_async(lambda: control.messages_of(SetFace))
        assert control.messages_of(SetFace)[-1].face.acoustic == "full"

        await other.send_json({"follow": "one"})
        await receive_json(other, "session", session="one")
        control.start("one", epoch=EPOCH + 1)
        await receive_json(newest, "session", session="one", epoch=EPOCH + 1)
        control.stop_session("one")
        await receive_json(newest, "session", session=None)
        await other.send_json({"avatar": [["jawOpen"]]})
        await receive_json(other, "avatar", set="arkit", targets=[[0, 0]])
        await other.send_str("[[[[")
        await receive_json(other, "error", code="refused")


@async_test
async def test_viewers_see_a_session_whose_name_was_used_before(
    control: FakeControl, gateway: Gateway
) -> None:
    async with open_websockets(gateway.page, "viewer?session=again") as (viewer,):
        control.start("again", epoch=EPOCH + 1)
        await receive_json(viewer, "session", session="again", epoch=EPOCH + 1)
        control.start("again", token="another")  # the gateway missed the close
        await receive_json(viewer, "session", session="again", epoch=EPOCH)
        publish_all(control, "again")
        assert (await receive_binary(viewer, FAP_TYPE))[16:] == FACE


@async_test
async def test_viewers_receive_shapes_in_the_requested_format(
    control: FakeControl, gateway: Gateway
) -> None:
    query = "viewer?session=shaped&shapes=vrm"
    weights = VRM.weights(np.frombuffer(FACE, "<f4"))
    paths = (query, f"{query}&format=json", f"{query}&format=msgpack")
    async with open_websockets(gateway.page, *paths) as viewers:
        binary, text, packed = viewers
        for viewer in viewers:
            await receive_json(viewer, "shapes", set="vrm", names=[*VRM.names])
        assert len(await receive_binary(binary, REST_SHAPES_TYPE)) == 16 + 4 * len(VRM.names)
        assert {*(await receive_json(text, "rest"))["weights"]} == {*VRM.names}
        control.start("shaped")
        publish_all(control, "shaped")
        assert (await receive_binary(binary, FAP_TYPE))[16:] == FACE
        shapes = await receive_binary(binary, SHAPES_TYPE)
        assert struct.unpack_from("<B3xId", shapes) == (SHAPES_TYPE, EPOCH, 320.0)
        np.testing.assert_array_equal(np.frombuffer(shapes, "<f4", offset=16), weights)
        frames = [await receive_json(text, "weights")]
        while len(frames) < 2:
            message = await packed.receive(60)
            if message.type is aiohttp.WSMsgType.BINARY and message.data[0] >= 0x80:
                frame = msgpack.unpackb(message.data)
                frames += [frame] if frame["epoch"] else []  # 0: at rest
        for frame in frames:
            assert (frame["type"], frame["set"]) == ("weights", "vrm")
            assert (frame["epoch"], frame["media_time"]) == (EPOCH, 320)
            assert [*frame["weights"]] == [*VRM.names]
            np.testing.assert_allclose([*frame["weights"].values()], weights, atol=1e-4)
    control.stop_session("shaped")


@async_test
async def test_a_viewer_sets_the_expressions_of_its_face(
    control: FakeControl, gateway: Gateway
) -> None:
    viewers = open_websockets(gateway.page, *2 * ["viewer?session=seen"])
    async with viewers as (viewer, other):
        await viewer.send_json({"expressiveness": 2})
        assert "no session is shown" in (await receive_json(viewer, "error"))["text"]
        control.start("seen")
        await receive_json(viewer, "session", session="seen")
        await viewer.send_json({"expressions": {"joy": 0.5, "squint": 1}, "hold_s": 7})
        await viewer.send_json({"expressions": {}})
        await viewer.send_json({"expressiveness": 2})
        await wait_until_async(lambda: len(control.messages_of(SetFace)) == 3)
        size = {"expressiveness": 2.0, "feeling": None}
        await receive_json(other, "face", lip_model="dynamic-visemes", **size)
    faces = [message.face for message in control.messages_of(SetFace)]
    assert [face.expressions for face in faces] == [{"joy": 0.5, "squint": 1.0}, {}, None]
    assert (faces[0].hold_s, faces[2].expressiveness) == (7, 2.0)
    assert {*control.sessions_of(SetFace)} == {"seen"}
    control.stop_session("seen")


@async_test
async def test_an_expression_shows_on_the_face_at_rest(
    control: FakeControl, gateway: Gateway
) -> None:
    corner = FAP_NUMBER["raise_l_cornerlip"] - 1

    async def watch(viewer: aiohttp.ClientWebSocketResponse) -> float:
        message = await receive_binary(viewer, REST_TYPE)
        return float(np.frombuffer(message, "<f4", offset=16)[corner])

    async with open_websockets(gateway.page, "viewer?session=none") as (viewer,):
        assert await watch(viewer) == 0
        await viewer.send_json({"expressions": {"smile": 1}, "hold_s": 600})
        while await watch(viewer) < 30:
            pass
        await viewer.send_json({"expressions": {}})
        while await watch(viewer) > 1:
            pass
    assert {*control.sessions_of(SetFace)} == {""}


@async_test
async def test_a_slow_viewer_gets_the_newest_frames(control: FakeControl, gateway: Gateway) -> None:
    times = [320 * number for number in range(1, 1001)]  # 20 s
    path = "viewer?session=long"
    with connect_with_small_buffer(gateway.page, path) as slow:
        async with open_websockets(gateway.page, path) as (viewer,):
            control.start("long")
            await receive_json(viewer, "session", session="long")
            for media_time in times:
                control.publish(control.faps, fap_frame("long", media_time // 320, FACE))
                if media_time % 6400 == 0:  # the gateway and this viewer keep up
                    while media_time_of(await receive_binary(viewer, FAP_TYPE)) < media_time:
                        pass
                    slow.sendall(PONG)
        received = b""
        while struct.pack("<d", times[-1]) + FACE not in received:
            chunk = slow.recv(65536)
            assert chunk, "the gateway has closed the connection"
            received += chunk
    assert received.count(FACE) < len(times) / 2
    control.stop_session("long")


# --- microphones and the sample sentence


@async_test
async def test_bad_audio_is_rejected_with_a_reason(control: FakeControl, gateway: Gateway) -> None:
    hello = json.dumps({"sample_rate_hz": 16000})
    for messages, reason in (
        (['{"sample_rate_hz": 4000}'], "sample_rate_hz"),
        ([b"\x00\x00"], "describes the audio"),
        ([hello, b"RIFF" + bytes(40)], "WAV file"),
    ):
        async with open_websockets(gateway.page, "microphone") as (microphone,):
            for message in messages:
                send = microphone.send_str if isinstance(message, str) else microphone.send_bytes
                await send(message)  # type: ignore[arg-type]
            text = (await receive_json(microphone, "error"))["text"]
            assert reason in text
            assert (await microphone.receive(LIMIT_S)).extra == text[:123]  # of the close
    async with open_websockets(gateway.page, "microphone") as (microphone,):
        await microphone.send_str(hello)
        await receive_json(microphone, "opened")
        await microphone.send_bytes(bytes(MAX_MESSAGE_BYTES + 1))
        closing = await microphone.receive(LIMIT_S)
        assert closing.data == aiohttp.WSCloseCode.MESSAGE_TOO_BIG
        assert closing.extra == "a message is larger than 4096 KiB; send it in smaller messages"
    control.refuse = True
    async with open_websockets(gateway.page, "microphone") as (microphone,):
        await microphone.send_str(hello)
        assert (await receive_json(microphone, "error"))["text"] == "start one"


MALFORMED: list[str | bytes] = [
    "", "{", "null", "[]", "5", '"x"', '{"type": "x"}', '{"a":' * 1000, "\0", "人" * 1000,
    '{"sample_rate_hz": "x"}', '{"encoding": []}', '{"session": {}}', '{"lip_model": 1}',
    '{"flush": "x"}', '{"expressions": {"joy": NaN}}', '{"mouth_profile": "%%"}', '{"last": 1}',
    b"", b"\0", b"\xff" * 7, bytes(20_000), b"RIFF" + bytes(60),
]  # fmt: skip


@async_test
async def test_malformed_messages_do_not_disturb_other_clients(
    control: FakeControl, gateway: Gateway
) -> None:
    flood(port_of(gateway.page), 0.5)
    for path in ("viewer", "microphone"):
        for malformed in MALFORMED:
            async with open_websockets(gateway.page, path) as (client,):
                send = client.send_str if isinstance(malformed, str) else client.send_bytes
                await send(malformed)  # type: ignore[arg-type]
    async with open_websockets(gateway.page, "microphone") as (microphone,):
        await microphone.send_json({"sample_rate_hz": 16000})
        await receive_json(microphone, "opened")
        await microphone.send_bytes(bytes(640))
        await wait_until_async(lambda: control.audio_messages)


@async_test
async def test_a_microphone_continues_after_a_bad_command(
    control: FakeControl, gateway: Gateway
) -> None:
    async with open_websockets(gateway.page, "microphone") as (microphone,):
        await microphone.send_json({"sample_rate_hz": 16000})
        await receive_json(microphone, "opened")
        await microphone.send_str("{")
        assert "expected a JSON object" in (await receive_json(microphone, "error"))["text"]
        control.refuse = True
        await microphone.send_json({"expressions": {"joy": 1}, "last": True})
        assert (await receive_json(microphone, "error"))["text"] == "start one"
        await microphone.receive(LIMIT_S)
        assert microphone.close_code == aiohttp.WSCloseCode.OK, "the end of the audio was executed"
    async with open_websockets(gateway.page, "microphone") as (microphone,):
        control.refuse = False
        await microphone.send_json({"sample_rate_hz": 16000})
        await microphone.send_json({"sample_rate_hz": 48000})
        assert "cannot change" in (await receive_json(microphone, "error"))["text"]
        await microphone.receive(LIMIT_S)
        assert microphone.close_code == aiohttp.WSCloseCode.POLICY_VIOLATION


@async_test
async def test_microphone_and_sample_choose_their_lips(
    control: FakeControl, gateway: Gateway
) -> None:
    async with open_websockets(gateway.page, "viewer", "microphone") as (viewer, microphone):
        await microphone.send_json({"sample_rate_hz": 16000})
        await receive_json(microphone, "opened")
        await microphone.send_json({"stop": True})
        text = (await receive_json(microphone, "error"))["text"]
        assert text.startswith("unknown field stop; use skip, flush, last, lip_model, ")
        for lips in ("learned", "dynamic-visemes"):
            await microphone.send_json({"lip_model": lips})
            await receive_json(viewer, "face", lip_model=lips)
        await viewer.send_json({"lip_model": "learned"})
        assert "only for the sample sentence" in (await receive_json(viewer, "error"))["text"]
        await viewer.send_json({"play": "sample", "lip_model": "learned"})
        await wait_until_async(lambda: len(control.messages_of(SetFace)) == 3)
        await receive_json(viewer, "session", sample=True)
        await viewer.send_json({"lip_model": "dynamic-visemes"})
        await wait_until_async(lambda: len(control.messages_of(SetFace)) == 4)
        control.stop_session(control.sessions_of(SetFace)[3])
        await receive_json(viewer, "session", sample=False)
    sessions = control.sessions_of(SetFace)
    lips_chosen = tuple(message.face.lip_model for message in control.messages_of(SetFace))
    assert sessions[0] == sessions[1] != sessions[2] == sessions[3]
    assert lips_chosen == ("learned", "dynamic-visemes") * 2


# --- other programs


@async_test
async def test_the_newest_face_is_sent_to_another_program(
    control: FakeControl, gateway: Gateway
) -> None:
    senders = f"{gateway.page}senders"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        url = f"osc://127.0.0.1:{program.getsockname()[1]}"
        async with aiohttp.ClientSession() as http:
            for command in (
                {"start": "nonsense"},
                {},
                {"delay_ms": -1},
                {"delay_ms": 10**400},
                {"delay_ms": True},
                {"start": url, "stop": url},
                {"start": url, "rate": 30},
            ):
                async with http.post(senders, json=command) as answer:
                    assert answer.status == 422
                    assert (await answer.json())["error"]
            async with http.post(senders, json={"start": url}) as answer:
                assert [sender["target"] for sender in (await answer.json())["senders"]] == [url]
            await wait_until_async(lambda: time_sent(program) > 1.0)  # a face at rest
            for session in ("older", "newer"):
                control.start(session)
            for session in ("older", "newer"):
                publish_all(control, session)
            await wait_until_async(lambda: time_sent(program) == 320 / 16000)
            async with http.get(senders) as answer:
                (state,) = (await answer.json())["senders"]
            assert state["rate_hz"] > 0
            assert (state["contents"], state["problem"]) == ("ARKit shapes and head", "")
            assert state["delay_ms"] == 0
            async with http.post(senders, json={"delay_ms": 90}) as answer:
                assert [sender["delay_ms"] for sender in (await answer.json())["senders"]] == [90]
            async with http.post(senders, json={"stop": f"{url}/"}) as answer:
                assert await answer.json() == {"senders": [], "stopped": []}


def time_sent(program: socket.socket) -> float:
    """Return the time in the next frame; it is the frame's first message."""
    while (first := next(iter(OscBundle(program.recv(2000))))).address != "/kouxing/time":
        pass
    return round(float(first.params[0]), 3)
