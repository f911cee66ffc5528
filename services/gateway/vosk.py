"""The messages of vosk-server: its clients send sound and get phones back, where words would be.

A client may send ``{"config": {...}}`` first, then PCM in binary messages, and ``{"eof": 1}`` in
the end. Each message but a config gets one reply: ``{"partial": TEXT}``, or what was said since the
last one, ``{"result": [{"word", "start", "end", "conf"}, ...], "text": TEXT}``, which
``{"reset": 1}`` asks for.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import dataclass, field
from typing import Any

from aiohttp import WSCloseCode, WSMessage, WSMsgType, web

from kouxing.services.gateway import wire
from kouxing.services.gateway.http import WebSockets
from kouxing.services.gateway.own_sessions import OwnSessions
from kouxing.services.gateway.places import Places
from kouxing.services.gateway.sound_format import SoundFormat, check_text
from kouxing.services.gateway.sound_input import SoundInput
from kouxing.shared.errors import UserError
from kouxing.shared.logs import LOG
from kouxing.shared.phones.events import Phone
from kouxing.shared.wav_header import read_wav_header

MAX_CLIENTS = 16
DEFAULT_RATE_HZ = 8000  # as vosk-server's own
SOUND_LIMIT_S = 60.0  # for the first sound: somebody may have to allow the microphone
LAST_FRAME_LIMIT_S = 10.0  # for the last phones: they are what the client waits for
MAX_UTTERANCE_S = 20.0  # of speech without a pause; then what is final is told
COMMANDS = {"config", "flush", "reset", "eof"}
EXPECTED = 'binary messages of samples, {"config": {...}}, {"flush": 1}, {"reset": 1} or {"eof": 1}'


class Utterances:
    """The phones of a session, told utterance by utterance: from one pause to the next."""

    def __init__(self) -> None:
        self._phones: dict[tuple[int, int], Phone] = {}  # by epoch and index; not yet told
        self._told = (0, -1)  # epoch and index until which all is, be it revised or not
        self._epoch = 0
        self._is_speaking = False

    def accept(self, phone: Phone, *, is_silence: bool) -> None:
        """Take a phone, or what it is revised to."""
        number = self._epoch, phone.index
        if number <= self._told:
            return
        if is_silence:
            self._phones.pop(number, None)
        else:
            self._phones[number] = phone

    def hear(self, *, active: bool) -> None:
        """Take note that voice activity began or ended."""
        self._is_speaking = active

    def restart(self) -> None:
        """Forget what is not final: the session goes on with other indices."""
        self._phones = {number: phone for number, phone in self._phones.items() if phone.final}
        self._epoch += 1

    @property
    def text(self) -> str:
        """What was said and is not told."""
        return _text([*self._phones.values()])

    def take(self) -> list[Phone]:
        """Return the utterance that has ended, if one has; it is told once."""
        phones = [*self._phones.values()]
        is_over = not self._is_speaking and all(phone.final for phone in phones)
        is_long = phones and phones[-1].onset_s - phones[0].onset_s > MAX_UTTERANCE_S
        if not (is_over or is_long):
            return []
        self._phones = {n: phone for n, phone in self._phones.items() if not phone.final}
        return [phone for phone in phones if phone.final]

    def take_all(self) -> list[Phone]:
        """Return all that was not told, final or not; it is told once."""
        phones, self._told = [*self._phones.values()], max(self._phones, default=self._told)
        self._phones = {}
        return phones


@dataclass(slots=True)
class _Config:
    """What clients may choose; ``encoding``, ``num_channels`` and ``ahead`` are additions."""

    fields: dict[str, Any] = field(default_factory=dict)

    def update(self, fields: object) -> None:
        if not isinstance(fields, dict):
            raise UserError('expected {"config": {"sample_rate": 16000}}')
        self.fields |= fields

    def sound_format(self) -> SoundFormat:
        """Return the format of the sound that comes without a header."""
        rate = self.fields.get("sample_rate", DEFAULT_RATE_HZ)
        try:
            rate_hz = round(float(rate))
        except (TypeError, ValueError, OverflowError):
            raise UserError(f"sample_rate must be a number, such as 16000, not {rate!r}") from None
        stated = {"sample_rate_hz": rate_hz, "num_channels": 1, "encoding": "s16le"}
        return wire.parse_sound_format(stated | {**self.fields, "sample_rate_hz": rate_hz})

    def sound_of(self, first: bytes) -> tuple[SoundFormat, int]:
        """Return the format of sound that begins so, and the size of its WAV header, if any.

        Raises
        ------
        UserError
            If the header and the config disagree.
        """
        header = read_wav_header(first)
        if header is None:
            return self.sound_format(), 0
        stated = SoundFormat(
            sample_rate_hz=header.sample_rate_hz,
            num_channels=header.num_channels,
            encoding=header.encoding,
        )
        if "sample_rate" in self.fields and self.sound_format() != stated:
            raise UserError(f"config says {self.sound_format()}; the WAV header says {stated}")
        return stated, header.num_bytes

    def reply(self, utterances: Utterances) -> str:
        """Return the message that tells an utterance if one has ended, else what is said."""
        said = utterances.take()
        return self.result_of(said) if said else json.dumps({"partial": utterances.text})

    def result_of(self, phones: list[Phone]) -> str:
        """Return the message that these phones were said."""
        result: dict[str, Any] = {"text": _text(phones)}
        if phones and self.fields.get("words", True):
            words = [
                {
                    "conf": round(phone.confidence, 6),
                    "end": round(phone.onset_s + phone.duration_s, 6),
                    "start": round(phone.onset_s, 6),
                    "word": phone.symbol,
                }
                for phone in phones
            ]
            result = {"result": words} | result
        if self.fields.get("max_alternatives"):
            mean = sum(phone.confidence for phone in phones) / max(1, len(phones))
            result = {"alternatives": [{"confidence": round(mean, 6)} | result]}
        return json.dumps(result)


@dataclass(slots=True, eq=False)
class _Client:
    session: str = ""  # once it is open
    is_ending: bool = False  # the session's end is our own
    utterances: Utterances = field(default_factory=Utterances)


class VoskClients:
    """Streams each client's sound into a session of its own, and tells it the phones.

    Parameters
    ----------
    web_sockets
        Opens the clients' connections.
    share
        Of the places, for one address.
    own_sessions
        Opens the sessions.
    """

    def __init__(self, web_sockets: WebSockets, share: float, own_sessions: OwnSessions) -> None:
        self._web_sockets = web_sockets
        self._places = Places(MAX_CLIENTS, "vosk clients", share)
        self._own_sessions = own_sessions
        self._open: dict[web.WebSocketResponse, _Client] = {}

    def on_phone(self, session: str, phone: Phone, *, is_silence: bool) -> None:
        """Take a phone of any session, or what it is revised to."""
        for utterances in self._utterances(session):
            utterances.accept(phone, is_silence=is_silence)

    def on_speech(self, session: str, *, active: bool) -> None:
        """Take note that voice activity began or ended in any session."""
        for utterances in self._utterances(session):
            utterances.hear(active=active)

    def on_restart(self, session: str) -> None:
        """Take note that any session goes on in another epoch."""
        for utterances in self._utterances(session):
            utterances.restart()

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Serve one client until it has all phones, or leaves."""
        async with self._web_sockets.accept(request, self._places) as client:
            self._open[client] = _Client()
            try:
                with contextlib.suppress(ConnectionError):
                    await self._serve(client)
            finally:
                del self._open[client]
        return client

    async def close_session(self, session: str) -> None:
        """Tell the client of a session, if there is one, that control has closed it."""
        for socket, client in [*self._open.items()]:
            if client.session == session and not client.is_ending:
                await _refuse(socket, "the session was closed")

    def _utterances(self, session: str) -> list[Utterances]:
        return [each.utterances for each in self._open.values() if each.session == session]

    async def _serve(self, client: web.WebSocketResponse) -> None:
        config = _Config()
        try:
            async with asyncio.timeout(SOUND_LIMIT_S):
                first = await _first_sound(client, config)
            if first is not None:
                await self._stream(client, config, first)
        except TimeoutError:
            await _refuse(client, f"no sound within {SOUND_LIMIT_S:g} s; expected {EXPECTED}")
        except UserError as error:
            await _refuse(client, str(error))

    async def _stream(self, client: web.WebSocketResponse, config: _Config, first: bytes) -> None:
        """Open a session for a client, stream it, and tell in the end what was said last."""
        sound, header_bytes = config.sound_of(first)
        state = self._open[client]
        async with self._own_sessions.open(
            last_frame_limit_s=LAST_FRAME_LIMIT_S,
            encoding=sound.encoding,
            sample_rate_hz=sound.sample_rate_hz,
            num_channels=sound.num_channels,
        ) as session:
            state.session = session.name
            LOG.info("a vosk client is streaming", extra={"session": session.name})
            sound_input = SoundInput(session, sound, is_ahead=bool(config.fields.get("ahead")))
            try:
                async with sound_input.running():
                    await sound_input.accept(first[header_bytes:])
                    await client.send_str(config.reply(state.utterances))
                    async for message in sound_input.messages(client):
                        reply = await _handle(message, config, sound_input, state.utterances)
                        if reply:
                            await client.send_str(reply)
                        for error in session.errors():
                            raise error
            finally:
                state.is_ending = True
        if sound_input.has_ended:
            await client.send_str(config.result_of(state.utterances.take_all()))


async def _first_sound(client: web.WebSocketResponse, config: _Config) -> bytes | None:
    """Return the first sound that comes; None if the client leaves without."""
    async for message in client:
        if message.type is WSMsgType.BINARY:
            return bytes(message.data)
        if message.type is not WSMsgType.TEXT:
            break
        fields = _parse(message.data)
        if "config" in fields:
            config.update(fields["config"])
        elif fields.get("eof"):
            await client.send_str(config.result_of([]))
            break
        elif fields.get("reset"):
            await client.send_str(config.result_of([]))
        else:
            await client.send_str(config.reply(Utterances()))
    return None


async def _handle(
    message: WSMessage, config: _Config, sound_input: SoundInput, utterances: Utterances
) -> str:
    """Handle a message; return the reply that it gets now, if it gets one."""
    if message.type is WSMsgType.BINARY:
        await sound_input.accept(message.data)
        return config.reply(utterances)
    fields = _parse(message.data)
    if "config" in fields:
        config.update(fields["config"])
        return ""
    if fields.get("eof"):
        sound_input.end()
        return ""
    if fields.get("reset"):
        return config.result_of(utterances.take_all())
    utterances.restart()
    await sound_input.flush()
    return config.reply(utterances)


def _parse(message: str) -> dict[str, object]:
    check_text(message, EXPECTED)
    fields = wire.parse_object(message)
    if not fields.keys() & COMMANDS:
        raise UserError(f"expected {EXPECTED}")
    return fields


async def _refuse(client: web.WebSocketResponse, reason: str) -> None:
    """Say what is wrong, and close the connection."""
    with contextlib.suppress(ConnectionError):
        await client.send_str(json.dumps({"error": reason}))
    await client.close(code=WSCloseCode.UNSUPPORTED_DATA, message=reason.encode()[:120])


def _text(phones: list[Phone]) -> str:
    return " ".join(phone.symbol for phone in phones)
