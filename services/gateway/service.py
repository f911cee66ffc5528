"""The gateway as a service: sessions to browsers, a browser's microphone to a session.

Reacts to: start, stop (control), fap, end (synthesizer), sound, phone, speech (recognizer), report
(control), and to what browsers send. Emits: status (control), WebSocket messages (browsers), and,
as an ordinary client, audio (recognizer).
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import errno
import gc
import hashlib
import logging
import os
import re
import secrets
import signal
import socket
import time
from collections.abc import AsyncIterator, Coroutine
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from urllib.parse import urlsplit

from aiohttp import WSCloseCode, WSMsgType, web
from aiohttp.http import HttpProcessingError
from aiohttp.typedefs import Handler as WebHandler

from services.gateway import wire
from services.gateway.outbox import Kind, Outbox
from shared.audio_file import open_audio
from shared.bus import Socket, is_loopback
from shared.client import Client, Refused, Session
from shared.config import GatewayConfig
from shared.errors import UserError
from shared.logs import LOG
from shared.messages import (
    MAX_AUDIO_BYTES,
    EndOfFaps,
    Error,
    FapFrame,
    Joined,
    Message,
    PhoneHeard,
    Sound,
    Speech,
    StartSession,
    StatusReport,
    StatusRequest,
)
from shared.service import TICK_S, Handler, Service

PAGE = Path(__file__).parent / "page"
MODULES = PAGE / "node_modules" / "three"
SUFFIXES = {".html", ".js", ".css", ".svg", ".glb"}  # of the page's files that are given out
KINDS = (EndOfFaps, FapFrame, PhoneHeard, Sound, Speech)
NUM_PUBLISHERS = 2  # recognizer and synthesizer
SAMPLE = Path(str(resources.files("shared") / "demo" / "hello-female.wav"))
MAX_VIEWERS = 64
MAX_MICROPHONES = 16
SEND_BUFFER_BYTES = 64 * 1024  # what the kernel may hold for a slow viewer, about a second
PING_S = 20.0  # a browser that is gone without a word is noticed within this
HELLO_LIMIT_S = 10.0
FINISH_LIMIT_S = 1.5  # for the last frames, when a microphone ends
CONTROL_LIMIT_S = 3.0  # for control's answers
STATUS_S = 1.0
STATUS_LOST_S = 3.0
STOP_LIMIT_S = 4.0
_SESSION = re.compile(r"[A-Za-z0-9_-]{1,64}")
_IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


@dataclass(slots=True, eq=False)
class _Followed:
    """One session that this gateway is subscribed to."""

    start: StartSession
    socket: Socket
    publishers: set[str] = field(default_factory=set)  # that have confirmed
    ended: asyncio.Event = field(default_factory=asyncio.Event)  # the last frame has come


@dataclass(slots=True, eq=False)
class _Viewer:
    """One browser that looks on."""

    chosen: str  # the session it asked for; empty: the newest
    outbox: Outbox = field(default_factory=Outbox)
    shown: tuple[str, int] | None = None  # session and epoch that it was last told of


class GatewayService(Service):
    """The gateway process."""

    name = "gateway"
    _loop: asyncio.AbstractEventLoop | None = None  # while it runs

    def __init__(self, config: GatewayConfig) -> None:
        super().__init__(config)
        self._listener = _bind(config.host, config.port)
        self._loopback = is_loopback(config.host)
        self._head = config.head
        host = config.advertise or config.host
        port = self._listener.getsockname()[1]
        self.endpoints = {"page": f"http://{f'[{host}]' if ':' in host else host}:{port}/"}
        self._followed: dict[str, _Followed] = {}  # in the order in which they were opened
        self._viewers: set[_Viewer] = set()
        self._browsers: set[web.WebSocketResponse] = set()
        self._microphones: dict[web.WebSocketResponse, str] = {}  # and their sessions
        self._tasks: set[asyncio.Future[None]] = set()
        self._sample = ""  # the session in which the sample sentence is being played
        self._missing: tuple[str, ...] = ("control",)
        self._report_s = 0.0
        self._request_s = 0.0
        self._wake = asyncio.Event()
        self._status_socket = self.bus.connect_dealer(config.control)
        self.listen(
            self._status_socket,
            {
                StatusReport: lambda report, _: self._on_report(report),
                Error: lambda error, _: self.warn(error.code, f"control says: {error.text}"),
            },
        )

    # --- the loop --------------------------------------------------------------------------------

    def run(self) -> None:
        """Run until a signal asks for the end, then close every connection."""
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # browsers come and go
        asyncio.run(self._run())

    def listen(self, socket: Socket, handlers: dict[type[Message], Handler]) -> None:
        """Handle messages that arrive on a socket, by their type."""
        super().listen(socket, handlers)
        self._watch(socket.file_descriptor)

    def unlisten(self, socket: Socket) -> None:
        """Stop handling and close a socket."""
        if self._loop is not None:
            self._loop.remove_reader(socket.file_descriptor)
        super().unlisten(socket)

    async def _run(self) -> None:
        self._loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            self._loop.add_signal_handler(number, self._on_signal, number)
        for descriptor in self.file_descriptors:
            self._watch(descriptor)
        log = LOG.getChild("http")
        log.addFilter(self._is_of_note)
        runner = web.AppRunner(
            self._application(), access_log=None, logger=log, shutdown_timeout=0.5
        )
        await runner.setup()
        await web.SockSite(runner, self._listener).start()
        gc.collect()
        gc.freeze()
        self.announce_ready()
        while not self.stopping:
            await self._turn()
        self.request_stop()
        await self._disconnect()
        await runner.cleanup()
        for descriptor in self.file_descriptors:
            self._loop.remove_reader(descriptor)
        self.drain()

    def _is_of_note(self, record: logging.LogRecord) -> bool:
        """Keep what is no HTTP, and was answered so, from filling the log with tracebacks."""
        if record.exc_info and isinstance(record.exc_info[1], HttpProcessingError):
            self.warn("bad-http", "dropped a request: it is no HTTP")
            return False
        return True

    async def _turn(self) -> None:
        # The descriptors are edge-triggered: what a full batch left behind waits for the tick.
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._wake.wait(), TICK_S)
        self._wake.clear()
        self.step(0)

    async def _disconnect(self) -> None:
        closing = [
            asyncio.ensure_future(
                browser.close(code=WSCloseCode.GOING_AWAY, message=b"the gateway stops")
            )
            for browser in self._browsers
        ]
        deadline_s = time.monotonic() + STOP_LIMIT_S
        while (
            self._browsers or self._microphones or self._sample
        ) and time.monotonic() < deadline_s:
            await self._turn()  # the last frames of microphones' sessions still come
        for future in closing:
            future.cancel()
        await asyncio.gather(*closing, return_exceptions=True)

    def _begin(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)  # the loop itself keeps no reference
        task.add_done_callback(self._tasks.discard)

    def _watch(self, descriptor: int) -> None:
        if self._loop is not None:
            self._loop.add_reader(descriptor, self._wake.set)

    def _on_signal(self, number: int) -> None:
        if self.stopping:
            os._exit(128 + number)
        self.request_stop()
        self._wake.set()

    # --- from control ----------------------------------------------------------------------------

    def start_session(self, start: StartSession) -> bool:
        """Follow a session; confirm once the subscriptions are in effect."""
        self._let_go(start.session)
        followed = _Followed(start, self.bus.connect_subscriber(start.phones, start.faps))
        self.listen(
            followed.socket,
            {
                Joined: lambda message, _: self._on_joined(followed, message),
                EndOfFaps: lambda message, _: self._on_end(followed, message),
                FapFrame: lambda message, _: self._on_frame(message),
                PhoneHeard: lambda message, _: self._on_phone(message),
                Sound: lambda message, _: self._on_sound(message),
                Speech: lambda message, _: self._on_speech(message),
            },
        )
        followed.socket.subscribe_session(KINDS, start.session)
        self._followed[start.session] = followed
        self._tell_viewers()
        return False

    def stop_session(self, session: str) -> None:
        """Follow a session no longer; a microphone that feeds it is told."""
        self._let_go(session)
        self._tell_viewers()
        for browser, name in self._microphones.items():
            if name == session:
                self._begin(_close(browser, "the session was closed"))

    def idle_s(self) -> dict[str, float]:
        """Name the sessions followed, so that control can say which of them are no more."""
        return dict.fromkeys(self._followed, 0.0)

    def on_tick(self, now_s: float) -> None:
        """Ask control which services run."""
        answered = self._report_s >= self._request_s
        if now_s - self._request_s > (STATUS_S if answered else STATUS_LOST_S):
            self._request_s = now_s
            self._status_socket.send(StatusRequest(request=secrets.token_hex(8)))
        if now_s - self._report_s > STATUS_LOST_S:
            self._set_missing(("control",))

    def _let_go(self, session: str) -> None:
        followed = self._followed.pop(session, None)
        if followed is not None:
            followed.ended.set()
            self.unlisten(followed.socket)

    def _on_report(self, report: StatusReport) -> None:
        self._report_s = time.monotonic()
        running = {state.service for state in report.services if state.state == "ready"}
        needed = ("recognizer", "synthesizer")
        self._set_missing(tuple(service for service in needed if service not in running))

    def _set_missing(self, missing: tuple[str, ...]) -> None:
        if missing != self._missing:
            self._missing = missing
            for viewer in self._viewers:
                viewer.outbox.put(Kind.TEXT, self._status())

    def _status(self) -> str:
        return wire.text("status", missing=self._missing)

    # --- from the publishers ---------------------------------------------------------------------

    def _on_joined(self, followed: _Followed, joined: Joined) -> None:
        followed.publishers.add(joined.publisher)
        if len(followed.publishers) == NUM_PUBLISHERS:
            self.session_started(followed.start)

    def _on_frame(self, frame: FapFrame) -> None:
        message = wire.binary(wire.FAP_TYPE, frame.epoch, frame.media_time, frame.values)
        self._forward(frame.session, Kind.FRAME, message)

    def _on_sound(self, sound: Sound) -> None:
        message = wire.binary(wire.SOUND_TYPE, sound.epoch, sound.media_time, sound.pcm)
        self._forward(sound.session, Kind.SOUND, message)

    def _on_phone(self, phone: PhoneHeard) -> None:
        message = wire.text(
            "phone",
            index=phone.index,
            unit=phone.unit,
            media_time=phone.media_time,
            duration=phone.duration,
            confidence=phone.confidence,
            final=phone.final,
        )
        self._forward(phone.session, Kind.TEXT, message)

    def _on_speech(self, speech: Speech) -> None:
        message = wire.text("speech", active=speech.active, media_time=speech.media_time)
        self._forward(speech.session, Kind.TEXT, message)

    def _on_end(self, followed: _Followed, end: EndOfFaps) -> None:
        followed.ended.set()
        self._forward(end.session, Kind.TEXT, wire.text("end", media_time=end.media_time))

    def _forward(self, session: str, kind: Kind, message: str | bytes) -> None:
        for viewer in self._viewers:
            if viewer.shown is not None and viewer.shown[0] == session:
                self._put(viewer, kind, message)

    def _put(self, viewer: _Viewer, kind: Kind, message: str | bytes) -> None:
        num_dropped = viewer.outbox.put(kind, message)
        if num_dropped:
            self.metrics.count("dropped_slow_viewer", num_dropped)

    def _tell_viewers(self) -> None:
        for viewer in self._viewers:
            self._tell_viewer(viewer)

    def _tell_viewer(self, viewer: _Viewer) -> None:
        """Say which session the viewer sees now, if it is another than before."""
        newest = (name for name in reversed(self._followed) if name != self._sample)
        name = viewer.chosen or next(newest, self._sample)
        followed = self._followed.get(name)
        shown = None if followed is None else (name, followed.start.epoch)
        if shown != viewer.shown:
            viewer.shown = shown
            session, epoch = shown or (None, 0)
            message = wire.text("session", session=session, chosen=viewer.chosen, epoch=epoch)
            self._put(viewer, Kind.TEXT, message)

    # --- browsers --------------------------------------------------------------------------------

    def _application(self) -> web.Application:
        application = web.Application(middlewares=[self._guard])
        application.router.add_get("/viewer", self._view)
        application.router.add_get("/microphone", self._listen)
        application.router.add_get("/", self._file)
        application.router.add_get("/{name}", self._file)
        if MODULES.is_dir():
            for folder in ("build", "examples/jsm"):
                application.router.add_static(f"/modules/three/{folder}", MODULES / folder)
        else:
            LOG.warning("the page's modules are missing; run 'npm ci' in %s", PAGE)
        return application

    @web.middleware
    async def _guard(self, request: web.Request, handler: WebHandler) -> web.StreamResponse:
        # A page of a strange host that resolves to this machine (DNS rebinding) shows its own name
        # here; one that only connects to us shows it as the origin.
        try:
            host = urlsplit(f"//{request.headers.get('Host', '')}").hostname or ""
        except ValueError:
            host = ""
        if self._loopback and not is_loopback(host):
            raise web.HTTPForbidden(text="this gateway only answers as localhost\n")
        response = await handler(request)
        if not response.prepared:
            response.headers["X-Content-Type-Options"] = "nosniff"
            response.headers["Cache-Control"] = "no-cache"
        return response

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info.get("name", "index.html")
        path = PAGE / name
        if name == "head.glb" and self._head:
            path = Path(self._head)
        elif path.parent != PAGE or path.suffix not in SUFFIXES:
            raise web.HTTPNotFound
        if not path.is_file():
            if name == "head.glb":
                text = f"the head is missing; make it with 'kouxing head export {path}'\n"
                raise web.HTTPNotFound(text=text)
            raise web.HTTPNotFound
        if not MODULES.is_dir():
            text = "the page's modules are missing; run 'npm ci' in services/gateway/page\n"
            raise web.HTTPServiceUnavailable(text=text)
        response = web.FileResponse(path)
        if name == "index.html":
            response.headers["Content-Security-Policy"] = _content_policy(path)
        return response

    async def _accept(self, request: web.Request) -> web.WebSocketResponse:
        """Open a WebSocket for a page of this host."""
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != request.headers.get("Host"):
            raise web.HTTPForbidden(text="only this gateway's own page may connect\n")
        if self.stopping:
            raise web.HTTPServiceUnavailable(text="the gateway stops\n")
        browser = web.WebSocketResponse(
            heartbeat=PING_S, max_msg_size=MAX_AUDIO_BYTES, timeout=1.0, compress=False
        )
        await browser.prepare(request)
        self._browsers.add(browser)
        return browser

    async def _view(self, request: web.Request) -> web.StreamResponse:
        chosen = request.query.get("session", "")
        if chosen and not _SESSION.fullmatch(chosen):
            raise web.HTTPBadRequest(text="session: up to 64 letters, digits, '-' and '_'\n")
        if len(self._viewers) >= MAX_VIEWERS:
            raise web.HTTPServiceUnavailable(text=f"{MAX_VIEWERS} viewers are looking already\n")
        viewer = _Viewer(chosen)
        self._viewers.add(viewer)
        try:
            browser = await self._accept(request)
            _limit_send_buffer(request)
            viewer.outbox.put(Kind.TEXT, self._status())
            self._tell_viewer(viewer)
            writer = asyncio.ensure_future(_write(browser, viewer.outbox))
            try:
                async for message in browser:
                    if message.type is WSMsgType.TEXT:
                        self._obey(viewer, message.data)
            finally:
                writer.cancel()
                self._browsers.discard(browser)
        finally:
            self._viewers.discard(viewer)
        return browser

    def _obey(self, viewer: _Viewer, message: str) -> None:
        try:
            wish = wire.parse_object(message)
            session = wish.get("follow")
            if wish.get("play") == "sample":
                if not self._sample:
                    self._sample = f"sample-{secrets.token_hex(4)}"
                    self._begin(self._play_sample())
                viewer.chosen = self._sample
            elif isinstance(session, str) and (not session or _SESSION.fullmatch(session)):
                viewer.chosen = session
            else:
                raise UserError("expected 'follow' with a session's name, or 'play'")
        except UserError as error:
            viewer.outbox.put(Kind.TEXT, _error_text(error))
        self._tell_viewer(viewer)

    async def _play_sample(self) -> None:
        """Speak the sample sentence in a session of its own, for those who asked for it."""
        name, loop = self._sample, asyncio.get_running_loop()
        try:
            source = open_audio(SAMPLE)
            async with self._session(
                session=name,
                sample_rate_hz=source.sample_rate_hz,
                num_channels=source.num_channels,
            ) as session:
                due_s = loop.time()
                for block in source.blocks:
                    if name not in self._followed or self.stopping:
                        break
                    session.send(block * 32767)
                    due_s += len(block) / source.sample_rate_hz
                    await asyncio.sleep(due_s - loop.time())
        except UserError as error:
            for viewer in self._viewers:
                if viewer.chosen == name:
                    viewer.outbox.put(Kind.TEXT, _error_text(error))
        finally:
            self._sample = ""
            for viewer in self._viewers:
                viewer.chosen = "" if viewer.chosen == name else viewer.chosen
            self._tell_viewers()

    async def _listen(self, request: web.Request) -> web.StreamResponse:
        if len(self._microphones) >= MAX_MICROPHONES:
            text = f"{MAX_MICROPHONES} microphones are open already\n"
            raise web.HTTPServiceUnavailable(text=text)
        browser = await self._accept(request)
        self._microphones[browser] = ""
        try:
            await self._stream(browser)
        except UserError as error:
            with contextlib.suppress(ConnectionError):
                await browser.send_str(_error_text(error))
        finally:
            self._browsers.discard(browser)
            await browser.close()
            del self._microphones[browser]
        return browser

    async def _stream(self, browser: web.WebSocketResponse) -> None:
        """Open a session for a microphone and stream it; close it in the end."""
        try:
            first = await browser.receive(HELLO_LIMIT_S)
        except TimeoutError:
            raise UserError(f"no description of the audio within {HELLO_LIMIT_S:g} s") from None
        if first.type is not WSMsgType.TEXT:
            raise UserError("expected a JSON object that describes the audio first")
        hello = wire.parse_hello(first.data)
        async with self._session(
            encoding=hello.encoding,
            sample_rate_hz=hello.sample_rate_hz,
            num_channels=hello.num_channels,
        ) as session:
            self._microphones[browser] = session.name
            LOG.info("a microphone is streaming", extra={"session": session.name})
            await browser.send_str(wire.text("opened", session=session.name))
            try:
                await self._send_audio(browser, session, hello)
            finally:
                self._microphones[browser] = ""

    @contextlib.asynccontextmanager
    async def _session(self, **options: object) -> AsyncIterator[Session]:
        """Open a session as any client does; let it say its last and close it in the end."""
        client = Client(self.config.control, deadline_s=CONTROL_LIMIT_S)
        try:
            session = await asyncio.to_thread(client.open_session, **options)
            try:
                yield session
            finally:
                await self._finish(session)
        finally:
            await asyncio.to_thread(client.bus.close)

    async def _send_audio(
        self, browser: web.WebSocketResponse, session: Session, hello: wire.Hello
    ) -> None:
        async for message in browser:
            if message.type is WSMsgType.BINARY:
                num_frames, rest = divmod(len(message.data), hello.frame_bytes)
                if rest:
                    raise UserError(f"a chunk must be a multiple of {hello.frame_bytes} bytes")
                if not session.send_pcm(message.data, num_frames):
                    self.warn("slow_recognizer", "dropped audio: the recognizer is too slow")
            elif message.type is WSMsgType.TEXT and wire.parse_object(message.data).get("flush"):
                await asyncio.to_thread(session.flush)
            for error in session.errors():
                await browser.send_str(wire.text("error", code=error.code, text=error.text))

    async def _finish(self, session: Session) -> None:
        followed = self._followed.get(session.name)
        if followed is None:
            return  # control has closed it already
        session.finish()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(followed.ended.wait(), FINISH_LIMIT_S)
        try:
            await asyncio.to_thread(session.close)
        except UserError as error:
            self.warn("close", f"a microphone's session: {error}", session.name)


def _bind(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise UserError(
                f"gateway.port: {port} is in use on {host}; choose another (0: any free one)"
            ) from None
        if error.errno == errno.EACCES:
            raise UserError(f"gateway.port: {port} needs privileges; choose 1024 or more") from None
        raise UserError(
            f"gateway.host: cannot listen on {host!r}: {error.strerror}; "
            "use 127.0.0.1, or an address of this host"
        ) from None


def _content_policy(index: Path) -> str:
    """Return the policy that lets the page load nothing but its own files.

    The import map has to stand in the page itself, so it is allowed by its digest.
    """
    found = _IMPORT_MAP.search(index.read_text(encoding="utf-8"))
    digest = hashlib.sha256(found[1].encode() if found else b"").digest()
    import_map = f"'sha256-{base64.b64encode(digest).decode()}'"
    return (
        f"default-src 'self'; script-src 'self' {import_map}; img-src 'self' blob: data:; "
        "connect-src 'self' blob:; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
    )


def _error_text(error: UserError) -> str:
    if isinstance(error, Refused):
        return wire.text("error", code=error.code, text=error.text)
    return wire.text("error", code="refused", text=str(error))


def _limit_send_buffer(request: web.Request) -> None:
    raw = request.transport.get_extra_info("socket") if request.transport else None
    if raw is not None:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)


async def _write(browser: web.WebSocketResponse, outbox: Outbox) -> None:
    with contextlib.suppress(ConnectionError):
        while True:
            message = await outbox.get()
            if isinstance(message, str):
                await browser.send_str(message)
            else:
                await browser.send_bytes(message)


async def _close(browser: web.WebSocketResponse, reason: str) -> None:
    with contextlib.suppress(ConnectionError):
        await browser.send_str(wire.text("closed", text=reason))
    await browser.close(message=reason.encode())
