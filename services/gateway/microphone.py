"""Sound into the system: browsers' microphones, and the sample sentence."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from importlib import resources
from pathlib import Path

from aiohttp import WSMsgType, web

from kouxing.services.gateway import wire
from kouxing.services.gateway.http import WebSockets
from kouxing.services.gateway.own_sessions import OwnSession, OwnSessions, error_text
from kouxing.services.gateway.places import Places
from kouxing.services.gateway.sound_input import SoundInput
from kouxing.shared.audio_file import open_audio
from kouxing.shared.errors import UserError
from kouxing.shared.logs import LOG

SAMPLE = Path(str(resources.files("kouxing.shared") / "demo" / "hello-female.wav"))
SAMPLE_TEXT = "你好，欢迎来到口型。你听到的每一个字，都由我的脸实时说出来。"
MAX_MICROPHONES = 16
HELLO_LIMIT_S = 10.0


class Microphones:
    """Streams each browser's microphone into a session of its own.

    Parameters
    ----------
    web_sockets
        Opens the browsers' connections.
    share
        Of the places, for one address.
    own_sessions
        Opens the sessions.
    """

    def __init__(self, web_sockets: WebSockets, share: float, own_sessions: OwnSessions) -> None:
        self._web_sockets = web_sockets
        self._places = Places(MAX_MICROPHONES, "microphones", share)
        self._own_sessions = own_sessions
        self._open: dict[web.WebSocketResponse, str] = {}  # and their sessions

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Serve one microphone until it is turned off."""
        async with self._web_sockets.accept(request, self._places) as browser:
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
        sound = hello.sound
        async with self._own_sessions.open(
            encoding=sound.encoding,
            sample_rate_hz=sound.sample_rate_hz,
            num_channels=sound.num_channels,
            voice=hello.mouth_profile,
        ) as session:
            self._open[browser] = session.name
            LOG.info("a microphone is streaming", extra={"session": session.name})
            await browser.send_str(wire.text("opened", session=session.name))
            sound_input = SoundInput(session, sound, is_ahead=hello.is_ahead)
            try:
                async with sound_input.running():
                    await self._forward_audio(browser, session, sound_input)
            finally:
                self._open[browser] = ""

    async def _forward_audio(
        self, browser: web.WebSocketResponse, session: OwnSession, sound_input: SoundInput
    ) -> None:
        async for message in sound_input.messages(browser):
            if message.type is WSMsgType.BINARY:
                await sound_input.accept(message.data)
            elif message.type is WSMsgType.TEXT:
                command = wire.parse_command(message.data)
                session.skip(command.num_skipped)
                if command.flush:
                    await sound_input.flush()
                if command.lips:
                    await session.choose_lips(command.lips)
                if command.eof:
                    sound_input.end()
            for error in session.errors():
                await browser.send_str(error_text(error))


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
                if session.is_closed:
                    break
                if lips != self.lips:
                    lips = self.lips
                    await session.choose_lips(lips)
                session.send((block * 32767).astype("<i2").tobytes(), len(block))
                due_s += len(block) / source.sample_rate_hz
                await asyncio.sleep(due_s - loop.time())
