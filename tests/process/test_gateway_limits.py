"""Limits of the gateway's port: incomplete requests, and too many connections."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from aiohttp.typedefs import Handler

from kouxing.services.gateway import microphone, viewers, web_server, whip
from kouxing.services.gateway.http import WebSockets
from kouxing.services.gateway.microphone import Microphones
from kouxing.services.gateway.viewers import Viewers
from kouxing.services.gateway.web_server import WebServer
from kouxing.services.gateway.whip import MISSING, WhipClients
from kouxing.shared.metrics import Metrics
from tests.process.web_clients import async_test
from tests.system import Gateway, port_of

UPGRADE = b"GET /long HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: upgrade\r\n\r\n"
SDP = {"Content-Type": "application/sdp"}
UNUSED: Any = None


@dataclass
class Served:
    """A server with short and endless answers."""

    address: tuple[str, int]
    refused: list[str] = field(default_factory=list)
    writers: list[asyncio.StreamWriter] = field(default_factory=list)

    async def connect(self, request: bytes = b"") -> asyncio.StreamReader:
        reader, writer = await asyncio.open_connection(*self.address)
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


async def never_end(request: web.Request) -> web.StreamResponse:
    await request.read()
    response = web.StreamResponse()
    await response.prepare(request)
    await response.write(b"begun")
    await asyncio.sleep(3600)
    return response


@asynccontextmanager
async def serve(monkeypatch: pytest.MonkeyPatch, **limits: float) -> AsyncIterator[Served]:
    """Serve with other limits; ``/long`` has no time limit."""
    for name, limit in {"_CHECK_S": 0.02, **limits}.items():
        monkeypatch.setattr(web_server, name, limit)
    bound = web_server.bind_port("127.0.0.1", 0)
    served = Served(bound.getsockname())
    server = WebServer(bound, None, on_refused=served.refused.append, on_bad_request=lambda: None)
    application = web.Application()
    application.add_routes(
        [web.get("/", answer), web.get("/slow", never_end), web.route("*", "/long", never_end)]
    )
    await server.start(application, {"/long"})
    try:
        yield served
    finally:
        await server.stop()
        for writer in served.writers:
            writer.close()


async def read_to_end(reader: asyncio.StreamReader) -> bytes:
    return await asyncio.wait_for(reader.read(), 20)


async def check_open(reader: asyncio.StreamReader) -> None:
    """Check that an endless answer has started and continues."""
    await asyncio.wait_for(reader.readuntil(b"begun"), 20)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(reader.read(), 0.2)


@pytest.mark.parametrize("part", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: a\r\nX: "])
@async_test
async def test_closes_connections_without_a_request(
    monkeypatch: pytest.MonkeyPatch, part: bytes
) -> None:
    async with serve(monkeypatch, IDLE_TIMEOUT_S=0.2) as served:
        assert await read_to_end(await served.connect(part)) == b""
        assert await served.answers()


@async_test
async def test_ends_slow_answers_except_on_unlimited_paths(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with serve(monkeypatch, IDLE_TIMEOUT_S=0.2, ANSWER_TIMEOUT_S=0.5) as served:
        long = await served.connect(b"GET /long HTTP/1.1\r\nHost: a\r\n\r\n")
        slow = await served.connect(b"GET /slow HTTP/1.1\r\nHost: a\r\n\r\n")
        assert b"begun" in await read_to_end(slow)
        await check_open(long)


@pytest.mark.parametrize(
    "part",
    [
        b"POST /long HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n1",
        b"POST /long HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n1\r\n1\r\n",
        b"GET /long HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n1",
    ],
)
@async_test
async def test_a_body_has_a_deadline_and_its_answer_has_none(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, part: bytes
) -> None:
    async with serve(monkeypatch, BODY_TIMEOUT_S=0.3) as served:
        post = b"POST /long HTTP/1.1\r\nHost: a\r\nContent-Length: 2\r\n\r\n"
        complete = [await served.connect(post), await served.connect(UPGRADE)]
        served.writers[0].write(b"12")
        incomplete = await served.connect(part)
        with contextlib.suppress(ConnectionResetError):
            assert await read_to_end(incomplete) == b""
        for reader in complete:
            await check_open(reader)
    assert not caplog.records


@async_test
async def test_refuses_connections_above_the_limit_until_one_closes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with serve(monkeypatch, IDLE_TIMEOUT_S=0.5, MAX_CONNECTIONS=6) as served:
        accepted = [await served.connect() for _ in range(5)]
        with contextlib.suppress(ConnectionResetError):
            assert await (await served.connect()).read() == b""
        assert served.refused == ["127.0.0.1"]
        for reader in accepted:
            assert await read_to_end(reader) == b""
        async with asyncio.timeout(20):
            while not await served.answers():
                await asyncio.sleep(0.02)


CLIENTS: dict[str, Callable[[float], Handler]] = {
    "viewers": lambda share: Viewers(WebSockets(), share, Metrics(), UNUSED, UNUSED, UNUSED).serve,
    "microphones": lambda share: Microphones(WebSockets(), share, UNUSED).serve,
}


@pytest.mark.parametrize(
    ("kind", "share", "num_per_address"), [("viewers", 0.75, 3), ("microphones", 1.0, 4)]
)
@async_test
async def test_one_address_gets_only_its_share_unless_it_is_a_proxys(
    monkeypatch: pytest.MonkeyPatch, kind: str, share: float, num_per_address: int
) -> None:
    monkeypatch.setattr(viewers, "MAX_VIEWERS", 4)
    monkeypatch.setattr(microphone, "MAX_MICROPHONES", 4)
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
        async with asyncio.timeout(20):
            while await connect("127.0.0.1") is None:
                await asyncio.sleep(0.02)


@asynccontextmanager
async def whip_offer(clients: WhipClients) -> AsyncIterator[Callable[[], Any]]:
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
    monkeypatch.setattr(whip, "MAX_CLIENTS", 4)
    clients = WhipClients(0.75, UNUSED, UNUSED, [])
    may_end = asyncio.Event()

    async def make_peer(_client: object) -> None:
        await may_end.wait()
        raise web.HTTPNotImplemented

    monkeypatch.setattr(clients, "_make_peer", make_peer)
    async with whip_offer(clients) as offer, asyncio.timeout(20):
        waiting = [asyncio.create_task(offer()) for _ in range(3)]
        while len(clients) < 3:
            await asyncio.sleep(0.01)
        assert (await offer())[0] == 503
        may_end.set()
        assert [(await task)[0] for task in waiting] == [501] * 3
        assert (await offer())[0] == 501, "the quota must be released"


@async_test
async def test_whip_without_aiortc_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiortc", None)
    monkeypatch.delitem(sys.modules, "kouxing.services.gateway.webrtc", raising=False)
    clients = WhipClients(1.0, UNUSED, UNUSED, ["127.0.0.1"])
    async with whip_offer(clients) as offer:
        assert await offer() == (501, MISSING)
    assert len(clients) == 0


@async_test
async def test_survives_running_out_of_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    class Exhausted(socket.socket):
        def accept(self) -> tuple[socket.socket, object]:
            if failures:
                raise OSError(24, failures.pop())
            return super().accept()

    failures = ["Too many open files"]
    monkeypatch.setattr(web_server, "_RETRY_S", 0.05)
    exhausted = Exhausted(fileno=web_server.bind_port("127.0.0.1", 0).detach())
    server = WebServer(exhausted, None, on_refused=lambda _: None, on_bad_request=lambda: None)
    application = web.Application()
    application.add_routes([web.get("/", answer)])
    await server.start(application, set())
    assert await Served(exhausted.getsockname()).answers()
    assert not failures
    await server.stop()


def test_logs_requests_that_are_not_http_once() -> None:
    gateway = Gateway("tcp://127.0.0.1:9", log_level="info")
    address = ("127.0.0.1", port_of(gateway.page))
    for garbage in (b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01" * 100, b"\xff\x00" * 5000):
        with socket.create_connection(address, 60) as client:
            client.sendall(garbage)
            assert b" 400 " in client.recv(100)
    gateway.process.terminate()
    _, log = gateway.process.communicate()
    assert log.count("not HTTP") == 1
    assert "Traceback" not in log
