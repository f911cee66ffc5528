"""Serves microphones: each WebSocket streams audio into a separate session."""

import contextlib

from aiohttp import WSCloseCode, WSMsgType, web
from kouxing_client import KouxingError

from kouxing.services.gateway.audio.audio_input import AudioInput
from kouxing.services.gateway.audio.audio_sessions import AudioClient, error_text
from kouxing.services.gateway.messages import browser_messages
from kouxing.services.gateway.messages.pcm_format import WrongFormat
from kouxing.services.gateway.web.limits import ConnectionQuota
from kouxing.services.gateway.web.web_application import OpenWebSockets
from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG

MAX_MICROPHONES = 16
OPTIONS_TIMEOUT_S = 10.0
MAX_MESSAGE_BYTES = 4 * 1024 * 1024  # 43 s of 48 kHz mono


class MicrophoneHandler:
    """Serves ``/microphone``."""

    def __init__(
        self, web_sockets: OpenWebSockets, address_share: float, audio_client: AudioClient
    ) -> None:
        self._web_sockets = web_sockets
        self._quota = ConnectionQuota(MAX_MICROPHONES, "microphones", address_share)
        self._audio_client = audio_client
        self._session_names: dict[web.WebSocketResponse, str] = {}

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Serve one microphone until it is turned off."""
        # No pings: while the queue is full, nothing is read, so pongs would not be seen.
        async with self._web_sockets.open(
            request, self._quota, max_message_bytes=MAX_MESSAGE_BYTES, ping_s=None
        ) as browser:
            try:
                await self._stream(browser)
                await browser.close(message=b"all audio was passed on")
            except (UserError, KouxingError) as error:
                with contextlib.suppress(ConnectionError):
                    await browser.send_str(error_text(error))
                reason = str(error).encode()
                await browser.close(code=WSCloseCode.POLICY_VIOLATION, message=reason)
        return browser

    async def close_session(self, session: str) -> None:
        """Notify the microphone of a session that control has closed the session."""
        for browser in [b for b, name in self._session_names.items() if name == session]:
            reason = "the session was closed"
            with contextlib.suppress(ConnectionError):
                await browser.send_str(browser_messages.encode_json("closed", text=reason))
            await browser.close(message=reason.encode())

    async def _stream(self, browser: web.WebSocketResponse) -> None:
        """Open a session for a microphone and stream its audio."""
        try:
            first = await browser.receive(OPTIONS_TIMEOUT_S)
        except TimeoutError:
            raise UserError(
                f"no description of the audio arrived within {OPTIONS_TIMEOUT_S:g} s; send it first"
            ) from None
        if first.type is not WSMsgType.TEXT:
            raise UserError("the first message must be a JSON object that describes the audio")
        options, problem = browser_messages.parse_microphone_options(first.data)
        async with self._audio_client.open(
            encoding=options.encoding,
            sample_rate_hz=options.sample_rate_hz,
            num_channels=options.num_channels,
            mouth_profile=options.mouth_profile or None,
            language=options.language or None,
        ) as session:
            self._session_names[browser] = session.name
            LOG.info("a microphone is streaming", extra={"session": session.name})
            await browser.send_str(browser_messages.encode_json("opened", session=session.name))
            if problem:
                await browser.send_str(browser_messages.encode_error(problem))
            audio_input = AudioInput(session, options, is_synthesized=bool(options.ahead))
            try:
                async with audio_input.running():
                    await _forward_audio(browser, audio_input)
            finally:
                del self._session_names[browser]


async def _forward_audio(browser: web.WebSocketResponse, audio_input: AudioInput) -> None:
    async for message in audio_input.messages(browser):
        if message.type is WSMsgType.BINARY:
            await audio_input.push(message.data)
        elif message.type is WSMsgType.TEXT:
            await _execute(message.data, browser, audio_input)
        for error in audio_input.session.take_errors():
            await browser.send_str(error_text(error))


async def _execute(text: str, browser: web.WebSocketResponse, audio_input: AudioInput) -> None:
    """Execute a command. An invalid or rejected one is answered; the session continues."""
    try:
        command = browser_messages.parse_command(text, audio_input.pcm_format)
    except WrongFormat:
        raise
    except UserError as error:
        await browser.send_str(error_text(error))
        return
    if command.problem:
        await browser.send_str(browser_messages.encode_error(command.problem))
    if command.skip:
        audio_input.skip(command.skip)
    try:
        if command.flush:
            await audio_input.flush()
        if command.face:
            await audio_input.session.set_face(**command.face)
    except KouxingError as error:
        await browser.send_str(error_text(error))
    if command.last:
        await audio_input.end()
