"""The sound of one client on its way into a session: as it comes, or kept to real time."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from aiohttp import WSMessage, WSMsgType, web

from kouxing.services.gateway.own_sessions import OwnSession
from kouxing.services.gateway.pace import COMMAND_S, Pace
from kouxing.services.gateway.sound_format import SoundFormat

MAX_AHEAD_S = 30.0  # that may wait; who sends more waits itself
PIECE_S = 0.04  # in which it goes on
KEEP_ALIVE_S = 20.0  # without sound, before a little silence keeps the session open
_NO_MORE = {WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR}


class SoundInput:
    """Takes what a client sends and hands it on.

    Parameters
    ----------
    session
        Gets the sound.
    form
        The format of it.
    is_ahead
        Whether it may come before its time, as speech that is synthesized: then it waits here and
        goes on in real time, and an interruption drops what waits. Otherwise it goes on at once.
    """

    def __init__(self, session: OwnSession, form: SoundFormat, *, is_ahead: bool) -> None:
        self._session = session
        self._format = form
        self._is_first = True
        self._gone: asyncio.Task[None] | None = None  # done when all has gone on after the end
        self._pace = Pace()
        self._queue = SoundQueue(session, form) if is_ahead else None

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Hand on what waits meanwhile."""
        if self._queue is None:
            yield
            return
        task = asyncio.create_task(self._queue.run())
        try:
            yield
        finally:
            task.cancel()

    async def accept(self, pcm: bytes) -> None:
        """Take a binary message; return when more may come.

        Raises
        ------
        UserError
            If it cannot be of the format.
        """
        num_frames = self._format.num_frames(pcm, is_first=self._is_first)
        self._is_first = self._is_first and not pcm
        if self._queue is not None:
            await self._queue.put(pcm)
        else:
            self._session.send(pcm, num_frames)
            await self._pace.keep(num_frames / self._format.sample_rate_hz)

    async def flush(self) -> None:
        """Interrupt: drop sound not yet shown."""
        if self._queue is not None:
            self._queue.clear()
        await self._session.flush()

    @property
    def has_ended(self) -> bool:
        """Whether the client said that no more comes."""
        return self._gone is not None

    def end(self) -> None:
        """Take note that no more sound comes."""
        waiting = self._queue.wait_until_empty() if self._queue is not None else asyncio.sleep(0)
        self._gone = asyncio.create_task(waiting)

    async def messages(self, client: web.WebSocketResponse) -> AsyncIterator[WSMessage]:
        """Yield what a client sends: until it leaves or, after ``end``, all sound has gone on."""
        while True:
            receiving = asyncio.create_task(client.receive())
            await asyncio.wait(
                {receiving, self._gone} if self._gone else {receiving},
                return_when=asyncio.FIRST_COMPLETED,
            )
            if not receiving.done():
                receiving.cancel()
                return
            message = receiving.result()
            if message.type in _NO_MORE:
                return
            if message.type is WSMsgType.TEXT:
                await self._pace.keep(COMMAND_S)
            yield message


class SoundQueue:
    """Sound that came before its time; it goes on in real time."""

    def __init__(self, session: OwnSession, form: SoundFormat) -> None:
        self._session = session
        self._format = form
        self._piece_bytes = round(PIECE_S * form.sample_rate_hz) * form.frame_bytes
        self._waiting = bytearray()
        self._filled = asyncio.Event()

    async def put(self, pcm: bytes) -> None:
        """Add sound; return when more may come."""
        self._waiting += pcm
        self._filled.set()
        while self._duration_s(self._waiting) > MAX_AHEAD_S:
            await asyncio.sleep(PIECE_S)

    def clear(self) -> None:
        """Drop what waits."""
        self._waiting.clear()

    async def wait_until_empty(self) -> None:
        """Return once all has gone on."""
        while self._waiting:
            await asyncio.sleep(PIECE_S)

    async def run(self) -> None:
        """Hand on what waits, without end."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            if not self._waiting:
                await self._wait_for_sound()
                due_s = loop.time()
            piece = bytes(self._waiting[: self._piece_bytes])
            del self._waiting[: self._piece_bytes]
            self._session.send(piece, len(piece) // self._format.frame_bytes)
            due_s += self._duration_s(piece)
            await asyncio.sleep(due_s - loop.time())

    async def _wait_for_sound(self) -> None:
        """Return once sound waits: a little silence, if none comes for long."""
        self._filled.clear()
        try:
            await asyncio.wait_for(self._filled.wait(), KEEP_ALIVE_S)
        except TimeoutError:
            self._waiting += bytes(self._piece_bytes)

    def _duration_s(self, pcm: bytes | bytearray) -> float:
        return len(pcm) / self._format.frame_bytes / self._format.sample_rate_hz
