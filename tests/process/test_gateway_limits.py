"""Limits of the gateway's port: incomplete requests, and too many connections."""

import asyncio
import contextlib
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from aiohttp.typedefs import Handler

from kouxing.services.gateway.audio import microphone_handler
from kouxing.services.gateway.audio.microphone_handler import MicrophoneHandler
from kouxing.services.gateway.config import ADDRESS_SHARE
from kouxing.services.gateway.viewers import viewer_handler
from kouxing.services.gateway.viewers.viewer_handler import ViewerHandler
from kouxing.services.gateway.web import web_server
from kouxing.services.gateway.web.web_application import OpenWebSockets
from kouxing.services.gateway.web.web_server import WebServer
from kouxing.services.gateway.webrtc import whip_handler
from kouxing.services.gateway.webrtc.whip_handler import NO_WEBRTC_TEXT, WhipHandler
from kouxing.shared.monitoring.metrics import Metrics
from tests.process.web_clients import async_test
from tests.system import LIMIT_S

LONG = b"GET /long HTTP/1.1\r\nHost: a\r\n\r\n"
SLOW = b"GET /slow HTTP/1.1\r\nHost: a\r\n\r\n"
UPGRADE = b"GET /long HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: upgrade\r\n\r\n"
SDP = {"Content-Type": "application/sdp"}
UNUSED: Any = None


@dataclass
class LimitedServer:
    """A server with short and endless answers, whose time a test lets pass."""

    address: tuple[str, int]
    now_s: float = 0.0
    writers: list[asyncio.StreamWriter] = field(default_factory=list)
    open_answers: list[web.StreamResponse] = field(default_factory=list)
    has_ended: asyncio.Event = field(default_factory=asyncio.Event)  # the endless answer

    async def never_end(self, request: web.Request) -> web.StreamResponse:
        await request.read()
        response = web.StreamResponse()
        await response.prepare(request)
        self.open_answers.append(response)
        await response.write(b"begun")
        await asyncio.sleep(3600)
        return response

    async def write_endlessly(self, request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse()
        await response.prepare(request)
        try:
            while True:
                await response.write(bytes(1 << 20))
        finally:
            self.has_ended.set()

    async def connect(self, request: bytes = b"", source: str = "") -> asyncio.StreamReader:
        local = (source, 0) if source else None
        reader, writer = await asyncio.open_connection(*self.address, local_addr=local)
        writer.write(request)
        self.writers.append(writer)
        return reader

    async def answers(self) -> bool:
        try:
            async with (
                aiohttp.ClientSession() as http,
                http.get("http://{}:{}/".format(*self.address)) as response,
            ):
                return response.status == 200
        except aiohttp.ClientConnectionError:
            return False


async def answer(_request: web.Request) -> web.StreamResponse:
    return web.Response(text="here")


async def fail(request: web.Request) -> web.StreamResponse:
    raise {"value": ValueError, "other": RuntimeError}[request.query["error"]]


@asynccontextmanager
async def serve(
    monkeypatch: pytest.MonkeyPatch, bound: socket.socket | None = None, **limits: float
) -> AsyncIterator[LimitedServer]:
    """Serve with other limits; ``/long`` and the paths in it have no time limit."""
    for name, limit in {"_CHECK_S": 0.01, "_SHUTDOWN_S": 0.01, **limits}.items():
        monkeypatch.setattr(web_server, name, limit)
    bound = bound or web_server.bind_port("127.0.0.1", 0)
    limited = LimitedServer(bound.getsockname())
    monkeypatch.setattr(web_server, "time", SimpleNamespace(monotonic=lambda: limited.now_s))
    http_server = WebServer(bound, None, ADDRESS_SHARE)
    application = web.Application()
    application.add_routes(
        [
            web.get("/", answer),
            web.get("/fail", fail),
            web.get("/slow", limited.never_end),
            web.get("/endless", limited.write_endlessly),
            web.route("*", "/long", limited.never_end),
            web.get("/long/{name}", limited.never_end),
        ]
    )
    await http_server.start(application, {"/long", "/long/{name}"})
    try:
        yield limited
    finally:
        await http_server.stop()
        for writer in limited.writers:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


async def read_to_end(reader: asyncio.StreamReader) -> bytes:
    with contextlib.suppress(ConnectionResetError):
        return await asyncio.wait_for(reader.read(), LIMIT_S)
    return b""


async def wait_for_answers(*readers: asyncio.StreamReader) -> None:
    for reader in readers:
        await asyncio.wait_for(reader.readuntil(b"begun"), LIMIT_S)


async def check_open(server: LimitedServer, *readers: asyncio.StreamReader) -> None:
    """Check that endless answers continue: their next bytes arrive."""
    for response in server.open_answers:
        with contextlib.suppress(ConnectionError):
            await response.write(b"more")
    for reader in readers:
        await asyncio.wait_for(reader.readuntil(b"more"), LIMIT_S)


@async_test
async def test_closes_connections_with_long_heads_or_many_requests(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    request = b"GET / HTTP/1.1\r\nHost: a\r\n"
    headers = b"".join(b"X%d: %s\r\n" % (number, b"x" * 8000) for number in range(100))
    async with serve(monkeypatch) as server:
        for part in (request + headers, SLOW + 50 * (request + b"\r\n")):
            await read_to_end(await server.connect(part))
        assert await server.answers()


@pytest.mark.parametrize("part", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: a\r\nX: "])
@async_test
async def test_closes_connections_without_a_request(
    monkeypatch: pytest.MonkeyPatch, part: bytes
) -> None:
    async with serve(monkeypatch) as server:
        reader = await server.connect(part)
        assert await server.answers(), "it was accepted after the other one"
        server.now_s += web_server.IDLE_TIMEOUT_S + 1.0
        await asyncio.wait_for(reader.read(), LIMIT_S)
        assert await server.answers()


@async_test
async def test_ends_slow_answers_except_on_unlimited_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serve(monkeypatch) as server:
        named = await server.connect(LONG.replace(b"/long", b"/long/name"))
        long, slow = await server.connect(LONG), await server.connect(SLOW)
        await wait_for_answers(named, long, slow)
        server.now_s += web_server.ANSWER_TIMEOUT_S + 1.0
        await asyncio.wait_for(slow.read(), LIMIT_S)
        await check_open(server, named, long)


INCOMPLETE = b"POST /long HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n1"


@pytest.mark.parametrize(
    "part",
    [
        INCOMPLETE,
        b"POST /long HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n1\r\n1\r\n",
        b"GET /long HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n1",
    ],
)
@async_test
async def test_a_body_has_a_deadline_and_its_answer_has_none(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, part: bytes
) -> None:
    async with serve(monkeypatch) as server:
        post = b"POST /long HTTP/1.1\r\nHost: a\r\nContent-Length: 2\r\n\r\n"
        complete = [await server.connect(post), await server.connect(UPGRADE)]
        server.writers[0].write(b"12")
        await wait_for_answers(*complete)
        incomplete = await server.connect(part)
        assert await server.answers()
        server.now_s += web_server.BODY_TIMEOUT_S + 1.0
        await read_to_end(incomplete)
        await check_open(server, *complete)
    assert not caplog.records


MANY = [f"127.0.1.{number}" for number in range(9)]


@pytest.mark.parametrize(
    ("part", "sources"),
    [
        (b"", ["127.0.0.1"]),
        (b"GET / HT", ["127.0.0.2"]),
        (b"GET / HT", MANY),
        (SLOW, ["127.0.0.1"]),
        (INCOMPLETE, MANY),
    ],
)
@async_test
async def test_a_client_takes_the_place_of_one_without_a_complete_request(
    monkeypatch: pytest.MonkeyPatch, part: bytes, sources: list[str]
) -> None:
    async with serve(monkeypatch, MAX_CONNECTIONS=6) as server:
        clients = [await server.connect(LONG)]
        await wait_for_answers(*clients)
        for n in range(9):
            await server.connect(part, sources[n % len(sources)])
            server.now_s += 1.0
        late = [await server.connect(LONG, source) for source in ("127.0.0.1", "127.0.0.3")]
        await wait_for_answers(*late)
        await check_open(server, *clients, *late)


@async_test
async def test_rejects_connections_while_all_slots_have_complete_requests(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with serve(monkeypatch, MAX_CONNECTIONS=6) as server:
        clients = [await server.connect(LONG) for _ in range(5)]
        await wait_for_answers(*clients)
        for _ in range(2):
            assert await read_to_end(await server.connect()) == b""
        server.writers[0].close()
        async with asyncio.timeout(LIMIT_S):
            while not await server.answers():
                await asyncio.sleep(0.02)
    assert [record.getMessage() for record in caplog.records] == [
        "rejected a connection from 127.0.0.1: too many connections are open"
    ]


@async_test
async def test_ends_answers_that_are_never_read(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serve(monkeypatch) as server:
        reader = await server.connect(b"GET /endless HTTP/1.1\r\nHost: a\r\n\r\n")
        await asyncio.wait_for(reader.readexactly(1), LIMIT_S)
        server.now_s += web_server.ANSWER_TIMEOUT_S + 1.0
        await asyncio.wait_for(server.has_ended.wait(), LIMIT_S)


CLIENTS: dict[str, Callable[[float], Handler]] = {
    "viewers": lambda share: (
        ViewerHandler(
            OpenWebSockets(), share, Metrics(), Mock(session=""), UNUSED, on_connected=Mock()
        ).serve
    ),
    "microphones": lambda share: MicrophoneHandler(OpenWebSockets(), share, UNUSED).serve,
}


@pytest.mark.parametrize(
    ("kind", "share", "num_per_address"), [("viewers", 0.75, 3), ("microphones", 1.0, 4)]
)
@async_test
async def test_one_address_gets_only_its_share_unless_it_is_a_proxys(
    monkeypatch: pytest.MonkeyPatch, kind: str, share: float, num_per_address: int
) -> None:
    monkeypatch.setattr(viewer_handler, "MAX_VIEWERS", 4)
    monkeypatch.setattr(microphone_handler, "MAX_MICROPHONES", 4)
    application = web.Application()
    application.add_routes([web.get("/", CLIENTS[kind](share))])
    async with TestServer(application) as server, AsyncExitStack() as stack:

        async def connect(address: str) -> aiohttp.ClientWebSocketResponse | None:
            connector = aiohttp.TCPConnector(local_addr=(address, 0))
            http = await stack.enter_async_context(aiohttp.ClientSession(connector=connector))
            try:
                return await http.ws_connect(server.make_url("/"))
            except aiohttp.WSServerHandshakeError as error:
                return None if error.status == 503 else pytest.fail(str(error))

        first = [await connect("127.0.0.1") for _ in range(5)]
        assert sum(client is not None for client in first) == num_per_address
        second = [await connect("127.0.0.2") for _ in range(5)]
        assert sum(client is not None for client in second) == 4 - num_per_address
        assert first[0] is not None
        await first[0].close()
        async with asyncio.timeout(LIMIT_S):
            while await connect("127.0.0.1") is None:
                await asyncio.sleep(0.02)


@asynccontextmanager
async def whip_offer(clients: WhipHandler) -> AsyncIterator[Callable[[], Any]]:
    """Serve WebRTC clients; yield a function that posts an offer."""
    application = web.Application()
    application.add_routes([web.post("/", clients.serve_post)])
    async with TestServer(application) as server, aiohttp.ClientSession() as http:

        async def offer() -> tuple[int, str]:
            async with http.post(server.make_url("/"), data="v=0", headers=SDP) as response:
                return response.status, await response.text()

        yield offer


@async_test
async def test_one_address_gets_only_its_share_of_webrtc_clients(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(whip_handler, "MAX_CLIENTS", 4)
    clients = WhipHandler(0.75, UNUSED, UNUSED, [])
    may_end, num_offers = asyncio.Event(), 0

    async def make_peer(_name: str) -> None:
        nonlocal num_offers
        num_offers += 1
        await may_end.wait()
        raise web.HTTPNotImplemented

    monkeypatch.setattr(clients, "_make_peer", make_peer)
    async with whip_offer(clients) as offer, asyncio.timeout(LIMIT_S):
        waiting = [asyncio.create_task(offer()) for _ in range(3)]
        while num_offers < 3:
            await asyncio.sleep(0.01)
        assert (await offer())[0] == 503
        may_end.set()
        assert [(await task)[0] for task in waiting] == [501] * 3
        assert (await offer())[0] == 501, "the quota must be released"


@async_test
async def test_whip_without_aiortc_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiortc", None)
    monkeypatch.delitem(sys.modules, "kouxing.services.gateway.webrtc.connection", raising=False)
    clients = WhipHandler(1.0, UNUSED, UNUSED, ["127.0.0.1"])
    async with whip_offer(clients) as offer:
        assert await offer() == (501, NO_WEBRTC_TEXT)
    assert len(clients) == 0


@pytest.mark.parametrize(("error", "status"), [("value", 400), ("other", 500), ("", 500)])
@async_test
async def test_logs_an_unexpected_error_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, error: str, status: int
) -> None:
    async with serve(monkeypatch) as server, aiohttp.ClientSession() as http:
        for _ in range(3):
            url = "http://{}:{}/fail?error=".format(*server.address)
            async with http.get(url + error) as response:
                assert response.status == status
                assert "Server" not in response.headers
                assert response.headers["X-Content-Type-Options"] == "nosniff"
    assert len(caplog.records) == 1
    assert ("Traceback" in caplog.text) == (status == 500)


@async_test
async def test_survives_running_out_of_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    class Exhausted(socket.socket):
        def accept(self) -> tuple[socket.socket, object]:
            if failures:
                raise OSError(24, failures.pop())
            return super().accept()

    failures = ["Too many open files"]
    exhausted = Exhausted(fileno=web_server.bind_port("127.0.0.1", 0).detach())
    async with serve(monkeypatch, exhausted, _RETRY_S=0.05) as server:
        assert await server.answers()
    assert not failures
