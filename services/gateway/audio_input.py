"""One client's audio on its way into a session, passed on at once or at real-time speed."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from aiohttp import WSMessage, WSMsgType, web

from kouxing.services.gateway.audio_sessions import AudioSession
from kouxing.services.gateway.limits import COMMAND_S, RateLimit
from kouxing.services.gateway.pcm_format import PcmFormat

MAX_AHEAD_S = 30.0  # audio that may be queued; then the client must wait
PIECE_S = 0.04  # duration of the pieces in which queued audio is passed on
KEEP_ALIVE_S = 20.0  # without audio, until a piece of silence keeps the session open
_END_TYPES = {WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR}


class AudioInput:
    """Passes a client's audio on to its session.

    If ``is_ahead``, audio may arrive faster than real time, as synthesized speech does. It is then
    queued here and passed on in real time, and an interruption drops the queue.
    """

    def __init__(self, session: AudioSession, pcm_format: PcmFormat, *, is_ahead: bool) -> None:
        self._session = session
        self._format = pcm_format
        self._is_first = True
        self._drained: asyncio.Task[None] | None = None  # done when all audio is passed on
        self._rate_limit = RateLimit()
        self._queue = RealTimeQueue(session, pcm_format) if is_ahead else None

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Pass on queued audio while the context is open."""
        if self._queue is None:
            yield
            return
        task = asyncio.create_task(self._queue.run())
        try:
            yield
        finally:
            task.cancel()

    async def push(self, pcm: bytes) -> None:
        """Take the audio of a binary message; return when more may be read.

        Raises
        ------
        UserError
            If the data does not have the announced format.
        """
        num_frames = self._format.num_frames(pcm, is_first=self._is_first)
        self._is_first = self._is_first and not pcm
        if self._queue is not None:
            await self._queue.put(pcm)
        else:
            self._session.send(pcm, num_frames)
            await self._rate_limit.wait(num_frames / self._format.sample_rate_hz)

    async def flush(self) -> None:
        """Interrupt: drop queued audio and audio whose face is not shown yet."""
        if self._queue is not None:
            self._queue.clear()
        await self._session.flush()

    def end(self) -> None:
        """Mark the end of the audio: ``messages`` ends when the queue is empty."""
        draining = self._queue.wait_until_empty() if self._queue is not None else asyncio.sleep(0)
        self._drained = asyncio.create_task(draining)

    async def messages(self, client: web.WebSocketResponse) -> AsyncIterator[WSMessage]:
        """Yield a client's messages until it leaves or, after ``end``, all audio is passed on."""
        while True:
            receiving = asyncio.create_task(client.receive())
            await asyncio.wait(
                {receiving, self._drained} if self._drained else {receiving},
                return_when=asyncio.FIRST_COMPLETED,
            )
            if not receiving.done():
                receiving.cancel()
                return
            message = receiving.result()
            if message.type in _END_TYPES:
                return
            if message.type is WSMsgType.TEXT:
                await self._rate_limit.wait(COMMAND_S)
            yield message


class RealTimeQueue:
    """Audio that arrived early. It is passed on in real time."""

    def __init__(self, session: AudioSession, pcm_format: PcmFormat) -> None:
        self._session = session
        self._format = pcm_format
        self._piece_bytes = round(PIECE_S * pcm_format.sample_rate_hz) * pcm_format.frame_bytes
        self._queued = bytearray()
        self._not_empty = asyncio.Event()

    async def put(self, pcm: bytes) -> None:
        """Queue audio; return when there is room for more."""
        self._queued += pcm
        self._not_empty.set()
        while self._duration_s(self._queued) > MAX_AHEAD_S:
            await asyncio.sleep(PIECE_S)

    def clear(self) -> None:
        """Drop queued audio."""
        self._queued.clear()

    async def wait_until_empty(self) -> None:
        """Return once all audio is passed on."""
        while self._queued:
            await asyncio.sleep(PIECE_S)

    async def run(self) -> None:
        """Pass on queued audio until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            if not self._queued:
                await self._wait_for_audio()
                due_s = loop.time()
            piece = bytes(self._queued[: self._piece_bytes])
            del self._queued[: self._piece_bytes]
            self._session.send(piece, len(piece) // self._format.frame_bytes)
            due_s += self._duration_s(piece)
            await asyncio.sleep(due_s - loop.time())

    async def _wait_for_audio(self) -> None:
        """Return once audio is queued. After a long pause, queue a piece of silence."""
        self._not_empty.clear()
        try:
            await asyncio.wait_for(self._not_empty.wait(), KEEP_ALIVE_S)
        except TimeoutError:
            self._queued += bytes(self._piece_bytes)

    def _duration_s(self, pcm: bytes | bytearray) -> float:
        return len(pcm) / self._format.frame_bytes / self._format.sample_rate_hz
