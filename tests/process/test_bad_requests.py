"""Malformed and hostile requests: each gets an error, and none leaves a traceback in the log."""

import contextlib
import socket
from collections.abc import Iterator

import pytest
from aiohttp import WSCloseCode, WSMsgType

from tests.process.web_clients import async_test, open_websockets
from tests.system import LIMIT_S, Gateway, port_of

UPGRADE = (
    b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
)
BODY = b"Content-Length: 2\r\n\r\n{}"
LONG = b"a" * 300


@pytest.fixture(scope="module")
def gateway() -> Iterator[Gateway]:
    gateway = Gateway("tcp://127.0.0.1:9", token="secret", log_level="info")
    yield gateway
    gateway.process.terminate()
    _, log = gateway.process.communicate(timeout=LIMIT_S)
    assert gateway.process.returncode == 0
    assert "Traceback" not in log
    assert "traceback" not in log
    for text in ("overlap", "invalid HTTP"):
        assert log.count(text) == 1, "a line is logged once a minute"


def ask(gateway: Gateway, request: bytes) -> str:
    """Return the head of the answer to a request; the server may close without reading it all."""
    with socket.create_connection(("127.0.0.1", port_of(gateway.page)), LIMIT_S) as client:
        with contextlib.suppress(ConnectionError):
            client.sendall(request)
        head = b""
        while b"\r\n\r\n" not in head:
            head += client.recv(1 << 16)
    return head.decode("latin-1")


@pytest.mark.parametrize(
    ("start", "rest", "status"),
    [
        (b"GET /" + LONG + b".js", b"\r\n", 404),
        (b"GET /modules/three/build/" + LONG, b"\r\n", 404),
        (b"GET /modules/face_mesh/" + LONG + b".js", b"\r\n", 404),
        (b"GET /%00.js", b"\r\n", 404),
        (b"GET /modules/three/build/%00", b"\r\n", 404),
        (b"GET /senders?token=secret", b"Origin: http://[\r\n\r\n", 403),
        (b"GET /senders?token=secret", b"Origin: http://\xff\r\n\r\n", 403),
        (b"GET /senders?token=secret", b"Origin: https://127.0.0.1\r\n\r\n", 403),
        (b"GET /senders?token=secret", b"Origin: http://127.0.0.1\r\n\r\n", 200),
        (b"GET /senders", b"Authorization: Bearer \xff\xe9\r\n\r\n", 403),
        (b"GET /senders?token=%ff%ed%a0%80", b"\r\n", 403),
        (b"POST /senders?token=secret", b"Content-Type: a/b; charset=no\r\n" + BODY, 422),
        (b"POST /senders?token=secret", b"Content-Length: 2\r\n\r\n\xff\xff", 422),
        (b"POST /senders?token=secret", b"Content-Length: 1000000\r\n\r\n" + b"a" * 200_000, 413),
        (b"POST /senders?token=secret", b"Transfer-Encoding: chunked\r\n\r\nz\r\n", 400),
        (b"GET /viewer?token=secret", b"Upgrade: websocket\r\n\r\n", 400),
        (b"GET /viewer?token=secret", UPGRADE + b"Sec-WebSocket-Protocol: a\r\n\r\n", 101),
        (b"GET /viewer?token=secret", UPGRADE + b"Sec-WebSocket-Protocol: b\r\n\r\n", 101),
        (b"POST /senders?token=secret", b"Content-Encoding: gzip\r\n" + BODY, 415),
        (b"POST /sound", b"Content-Encoding: br\r\n" + BODY, 415),
        (b"POST /unknown", b"Content-Encoding: deflate\r\n" + BODY, 415),
        (b"G\x00T /", b"\r\n", 400),
        (b"GET / HTTP/1.1\r\n\r\n", b"", 400),
        (b"\x16\x03\x01" * 100, b"", 400),
        (b"\xff\x00" * 5000, b"", 400),
    ],
)
def test_answers_to_bad_requests_have_no_version(
    gateway: Gateway, start: bytes, rest: bytes, status: int
) -> None:
    head = ask(gateway, start + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n" + rest)
    assert f" {status} " in head.partition("\r\n")[0]
    assert "cross-origin-resource-policy: same-origin" in head.lower()
    assert "server:" not in head.lower()
    assert "python" not in head.lower()


@pytest.mark.parametrize(
    ("message", "code"),
    [(b"a" * 200_000, WSCloseCode.MESSAGE_TOO_BIG), (b"\xff", WSCloseCode.INVALID_TEXT)],
)
@async_test
async def test_an_invalid_message_closes_the_connection(
    gateway: Gateway, message: bytes, code: WSCloseCode
) -> None:
    async with open_websockets(gateway.page, "viewer?token=secret") as (viewer,):
        await viewer._writer.send_frame(message, WSMsgType.TEXT)  # send_str encodes UTF-8
        while (closing := await viewer.receive(LIMIT_S)).type is not WSMsgType.CLOSE:
            assert closing.type in (WSMsgType.TEXT, WSMsgType.BINARY)
    assert closing.data == code


@pytest.mark.parametrize("length", [b"Content-Length: 99999999", b"Transfer-Encoding: chunked"])
def test_a_rejected_body_is_not_read(gateway: Gateway, length: bytes) -> None:
    request = b"POST /sound HTTP/1.1\r\nHost: 127.0.0.1\r\n" + length + b"\r\n\r\n"
    with socket.create_connection(("127.0.0.1", port_of(gateway.page)), LIMIT_S) as client:
        client.sendall(request)
        received = b""
        while data := client.recv(1 << 16):
            received += data
    assert b" 403 " in received
