"""Live audio into the system: browsers' microphones, and the sample sentence.

Both open sessions as any other client does. Audio comes in real time and cannot wait: what a full
queue does not take is left out, and media time goes on.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

from aiohttp import WSMsgType, web

from services.gateway import wire
from services.gateway.http import WebSockets
from services.gateway.pace import COMMAND_S, Pace
from shared.audio_file import open_audio
from shared.client import Client, Refused, Session
from shared.errors import UserError
from shared.keys import Key
from shared.logs import LOG

SAMPLE = Path(str(resources.files("shared") / "demo" / "hello-female.wav"))
SAMPLE_TEXT = "你好，欢迎来到口型。你听到的每一个字，都由我的脸实时说出来。"
MAX_MICROPHONES = 16
HELLO_LIMIT_S = 10.0
LAST_FRAME_LIMIT_S = 1.5  # for the last frames, when a microphone ends
CONTROL_LIMIT_S = 3.0  # for control's answers

Warn = Callable[[str, str, str], None]  # reason, text, session


@dataclass(slots=True, eq=False)
class _OwnSession:
    ended: asyncio.Event = field(default_factory=asyncio.Event)  # no more frames come
    is_closed: bool = False  # by control


class OwnSessions:
    """The sessions that the gateway itself has open, as a client of control.

    Parameters
    ----------
    control
        Where control takes commands.
    warn
        Counts and logs a problem.
    """

    def __init__(self, control: str, key: Key | None, warn: Warn) -> None:
        self._control = control
        self._key = key
        self._warn = warn
        self._open: dict[str, _OwnSession] = {}

    @contextlib.asynccontextmanager
    async def open(self, **options: object) -> AsyncIterator[Session]:
        """Open a session; let its last frame come and close it in the end.

        Raises
        ------
        UserError
            If control refuses or does not answer.
        """
        client = Client(self._control, key=self._key, deadline_s=CONTROL_LIMIT_S)
        try:
            session = await asyncio.to_thread(client.open_session, **options)
            own = self._open[session.name] = _OwnSession()
            try:
                yield session
            finally:
                await self._finish(session, own)
                del self._open[session.name]
        finally:
            await asyncio.to_thread(client.bus.close)

    def is_open(self, session: str) -> bool:
        """Return whether control still has a session that was opened here."""
        return session in self._open and not self._open[session].is_closed

    def on_last_frame(self, session: str) -> None:
        """Take note that the last frame of a session has come."""
        if session in self._open:
            self._open[session].ended.set()

    def on_closed(self, session: str) -> None:
        """Take note that control has closed a session."""
        if session in self._open:
            self._open[session].is_closed = True
            self._open[session].ended.set()

    def send(self, session: Session, pcm: bytes, num_frames: int) -> None:
        """Send audio that cannot wait, or leave it out if the recognizer is too slow."""
        if not session.send_pcm(pcm, num_frames):
            session.skip(num_frames)
            self._warn("slow_recognizer", "dropped audio: the recognizer is too slow", session.name)

    async def _finish(self, session: Session, own: _OwnSession) -> None:
        if own.is_closed:
            return
        session.finish()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(own.ended.wait(), LAST_FRAME_LIMIT_S)
        try:
            await asyncio.to_thread(session.close)
        except UserError as error:
            self._warn("close", str(error), session.name)


class Microphones:
    """Streams each browser's microphone into a session of its own."""

    def __init__(self, web_sockets: WebSockets, own_sessions: OwnSessions) -> None:
        self._web_sockets = web_sockets
        self._own_sessions = own_sessions
        self._open: dict[web.WebSocketResponse, str] = {}  # and their sessions

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Serve one microphone until it is turned off."""
        if len(self._open) >= MAX_MICROPHONES:
            text = f"{MAX_MICROPHONES} microphones are open already\n"
            raise web.HTTPServiceUnavailable(text=text)
        async with self._web_sockets.accept(request) as browser:
            self._open[browser] = ""
            try:
                await self._stream(browser)
            except UserError as error:
                with contextlib.suppress(ConnectionError):
                    await browser.send_str(error_text(error))
            finally:
                del self._open[browser]
        return browser

    async def close_session(self, session: str) -> None:
        """Tell the microphone of a session, if there is one, that control has closed it."""
        for browser in [browser for browser, name in self._open.items() if name == session]:
            reason = "the session was closed"
            with contextlib.suppress(ConnectionError):
                await browser.send_str(wire.text("closed", text=reason))
            await browser.close(message=reason.encode())

    async def _stream(self, browser: web.WebSocketResponse) -> None:
        """Open a session for a microphone and stream it."""
        try:
            first = await browser.receive(HELLO_LIMIT_S)
        except TimeoutError:
            raise UserError(f"no description of the audio within {HELLO_LIMIT_S:g} s") from None
        if first.type is not WSMsgType.TEXT:
            raise UserError("expected a JSON object that describes the audio first")
        hello = wire.parse_hello(first.data)
        async with self._own_sessions.open(
            encoding=hello.encoding,
            sample_rate_hz=hello.sample_rate_hz,
            num_channels=hello.num_channels,
            voice=hello.voice,
        ) as session:
            self._open[browser] = session.name
            LOG.info("a microphone is streaming", extra={"session": session.name})
            await browser.send_str(wire.text("opened", session=session.name))
            try:
                await self._forward_audio(browser, session, hello)
            finally:
                self._open[browser] = ""

    async def _forward_audio(
        self, browser: web.WebSocketResponse, session: Session, hello: wire.Hello
    ) -> None:
        pace = Pace()
        async for message in browser:
            if message.type is WSMsgType.BINARY:
                num_frames, rest = divmod(len(message.data), hello.frame_bytes)
                if rest:
                    raise UserError(f"a chunk must be a multiple of {hello.frame_bytes} bytes")
                self._own_sessions.send(session, message.data, num_frames)
                await pace.keep(num_frames / hello.sample_rate_hz)
            elif message.type is WSMsgType.TEXT:
                command = wire.parse_command(message.data)
                session.skip(command.num_skipped)
                if command.flush:
                    await asyncio.to_thread(session.flush)
                if command.lips:
                    await asyncio.to_thread(session.choose_lips, command.lips)
                await pace.keep(COMMAND_S)
            for error in session.errors():
                await browser.send_str(wire.error_text(error.text, error.code))


def error_text(error: UserError) -> str:
    """Return the message for a browser about what went wrong."""
    if isinstance(error, Refused):
        return wire.error_text(error.text, error.code)
    return wire.error_text(str(error))


class Sample:
    """The sample sentence, spoken once in a session of its own.

    Parameters
    ----------
    own_sessions
        Opens the session.
    lips
        The lip model that moves the mouth; empty: the synthesizer's own. It can be set anew while
        the sentence is spoken.
    """

    def __init__(self, own_sessions: OwnSessions, lips: str) -> None:
        self.session = f"sample-{secrets.token_hex(4)}"
        self.lips = lips
        self._own_sessions = own_sessions

    async def speak(self) -> None:
        """Speak the sentence in real time.

        Raises
        ------
        UserError
            If no session can be opened.
        """
        loop = asyncio.get_running_loop()
        source = open_audio(SAMPLE)
        async with self._own_sessions.open(
            session=self.session,
            sample_rate_hz=source.sample_rate_hz,
            num_channels=source.num_channels,
        ) as session:
            lips = ""
            due_s = loop.time()
            for block in source.blocks:
                if not self._own_sessions.is_open(self.session):
                    break
                if lips != self.lips:
                    lips = self.lips
                    await asyncio.to_thread(session.choose_lips, lips)
                pcm = (block * 32767).astype("<i2").tobytes()
                self._own_sessions.send(session, pcm, len(block))
                due_s += len(block) / source.sample_rate_hz
                await asyncio.sleep(due_s - loop.time())
