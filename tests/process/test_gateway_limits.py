"""Limits of the gateway's port: incomplete requests, and too many connections."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

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
from kouxing.services.gateway.whip import WhipClients
from kouxing.shared.metrics import Metrics
from tests.process.gateway_system import GatewayProcess, ScriptedSystem

pytestmark = pytest.mark.process

UPGRADE = b"GET /long HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: upgrade\r\n\r\n"


@dataclass
class Served:
    """A server with an application of one short and one endless answer."""

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
    port = WebServer(bound, None, on_refused=served.refused.append, on_bad_request=lambda: None)
    application = web.Application()
    application.add_routes(
        [web.get("/", answer), web.get("/slow", never_end), web.route("*", "/long", never_end)]
    )
    await port.start(application, {"/long"})
    try:
        yield served
    finally:
        await port.stop()
        for writer in served.writers:
            writer.close()


async def check_open(answer: asyncio.StreamReader) -> None:
    """Check that an endless answer has started and continues."""
    await asyncio.wait_for(answer.readuntil(b"begun"), 20)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(answer.read(), 0.2)


@pytest.mark.parametrize("half", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: a\r\nX: "])
def test_closes_connections_without_a_request(monkeypatch: pytest.MonkeyPatch, half: bytes) -> None:
    async def wait() -> None:
        async with serve(monkeypatch, IDLE_TIMEOUT_S=0.2) as served:
            assert await asyncio.wait_for((await served.connect(half)).read(), 20) == b""
            assert await served.answers()

    asyncio.run(wait())


def test_closes_idle_connections_after_a_request(monkeypatch: pytest.MonkeyPatch) -> None:
    async def wait() -> None:
        async with serve(monkeypatch, IDLE_TIMEOUT_S=0.2) as served:
            reader = await served.connect(b"GET / HTTP/1.1\r\nHost: a\r\n\r\nGET / HT")
            received = await asyncio.wait_for(reader.read(), 20)
            assert received.endswith(b"here")

    asyncio.run(wait())


def test_ends_slow_answers_except_on_unlimited_paths(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def wait() -> None:
        async with serve(monkeypatch, IDLE_TIMEOUT_S=0.2, ANSWER_TIMEOUT_S=0.5) as served:
            long = await served.connect(b"GET /long HTTP/1.1\r\nHost: a\r\n\r\n")
            slow = await served.connect(b"GET /slow HTTP/1.1\r\nHost: a\r\n\r\n")
            assert b"begun" in await asyncio.wait_for(slow.read(), 20)
            await check_open(long)

    asyncio.run(wait())


@pytest.mark.parametrize(
    "half",
    [
        b"POST /long HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n1",
        b"POST /long HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n1\r\n1\r\n",
        b"GET /long HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n1",
    ],
)
def test_a_body_has_a_deadline_and_its_answer_has_none(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, half: bytes
) -> None:
    async def wait() -> None:
        async with serve(monkeypatch, BODY_TIMEOUT_S=0.3) as served:
            post = b"POST /long HTTP/1.1\r\nHost: a\r\nContent-Length: 2\r\n\r\n"
            whole = [await served.connect(post), await served.connect(UPGRADE)]
            served.writers[0].write(b"12")
            held = await served.connect(half)
            with contextlib.suppress(ConnectionResetError):
                assert await asyncio.wait_for(held.read(), 20) == b""
            for reader in whole:
                await check_open(reader)

    asyncio.run(wait())
    assert not caplog.records


def test_refuses_connections_above_the_limit_until_one_closes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def fill() -> None:
        async with serve(monkeypatch, IDLE_TIMEOUT_S=0.5, MAX_CONNECTIONS=6) as served:
            held = [await served.connect() for _ in range(5)]
            with contextlib.suppress(ConnectionResetError):
                assert await (await served.connect()).read() == b""
            assert served.refused == ["127.0.0.1"]
            for reader in held:
                assert await asyncio.wait_for(reader.read(), 20) == b""
            async with asyncio.timeout(20):
                while not await served.answers():
                    await asyncio.sleep(0.02)

    asyncio.run(fill())


NOTHING: Any = None
CLIENTS: dict[str, Callable[[float], Handler]] = {
    "viewers": lambda share: (
        Viewers(WebSockets(), share, Metrics(), NOTHING, NOTHING, NOTHING).serve
    ),
    "microphones": lambda share: Microphones(WebSockets(), share, NOTHING).serve,
}


@pytest.mark.parametrize("kind", CLIENTS)
@pytest.mark.parametrize(("share", "num_per_address"), [(0.75, 3), (1.0, 4)])
def test_one_address_gets_only_its_share_unless_it_is_a_proxys(
    monkeypatch: pytest.MonkeyPatch, kind: str, share: float, num_per_address: int
) -> None:
    for module, name in (
        (viewers, "MAX_VIEWERS"),
        (microphone, "MAX_MICROPHONES"),
    ):
        monkeypatch.setattr(module, name, 4)

    async def fill() -> None:
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

            held = [await connect("127.0.0.1") for _ in range(5)]
            assert sum(socket_ is not None for socket_ in held) == num_per_address
            others = [await connect("127.0.0.2") for _ in range(5)]
            assert sum(socket_ is not None for socket_ in others) == 4 - num_per_address
            assert held[0] is not None
            await held[0].close()
            async with asyncio.timeout(20):
                while await connect("127.0.0.1") is None:
                    await asyncio.sleep(0.02)

    asyncio.run(fill())


def test_one_address_gets_only_its_share_of_webrtc_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whip, "MAX_CLIENTS", 4)

    async def fill() -> None:
        clients = WhipClients(0.75, NOTHING, NOTHING, [])
        is_over = asyncio.Event()

        async def wait(_client: object) -> None:
            await is_over.wait()
            raise web.HTTPNotImplemented

        monkeypatch.setattr(clients, "_make_peer", wait)
        application = web.Application()
        application.add_routes([web.post("/", clients.serve_post)])
        async with TestServer(application) as server, aiohttp.ClientSession() as http:

            async def offer() -> int:
                headers = {"Content-Type": "application/sdp"}
                async with http.post(server.make_url("/"), data="v=0", headers=headers) as answer:
                    return answer.status

            held = [asyncio.create_task(offer()) for _ in range(3)]
            async with asyncio.timeout(20):
                while len(clients) < 3:
                    await asyncio.sleep(0.01)
                assert await offer() == 503
                is_over.set()
                assert [await status for status in held] == [501, 501, 501]
                assert await offer() == 501, "the quota is released"

    asyncio.run(fill())


def test_survives_running_out_of_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    class Exhausted(socket.socket):
        def accept(self) -> tuple[socket.socket, object]:
            if failures:
                raise OSError(24, failures.pop())
            return super().accept()

    failures = ["Too many open files"]

    async def wait() -> None:
        monkeypatch.setattr(web_server, "_RETRY_S", 0.05)
        bound = web_server.bind_port("127.0.0.1", 0)
        exhausted = Exhausted(fileno=bound.detach())
        port = WebServer(exhausted, None, on_refused=lambda _: None, on_bad_request=lambda: None)
        application = web.Application()
        application.add_routes([web.get("/", answer)])
        await port.start(application, set())
        assert await Served(exhausted.getsockname()).answers()
        assert not failures
        await port.stop()

    asyncio.run(wait())


def test_logs_requests_that_are_not_http_once() -> None:
    system = ScriptedSystem()
    gateway = GatewayProcess(system)
    address = urlsplit(gateway.page)
    for garbage in (b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01" * 100, b"\xff\x00" * 5000):
        with socket.create_connection((address.hostname, address.port), 60) as client:
            client.sendall(garbage)
            assert b" 400 " in client.recv(100)
    gateway.process.terminate()
    assert gateway.process.stderr is not None
    log = gateway.process.stderr.read()
    gateway.stop()
    system.close()
    assert log.count("not HTTP") == 1
    assert "Traceback" not in log
