"""Forwards one client's audio to a session, immediately or in real time."""

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator

from aiohttp import WSMessage, WSMsgType, web
from kouxing_client import KouxingError

from kouxing.services.gateway.audio.audio_sessions import AudioSession
from kouxing.services.gateway.messages.pcm_format import HEADER_BYTES, PcmFormat
from kouxing.services.gateway.web.limits import COMMAND_S, RealTimeLimit
from kouxing.shared.audio.encoding_check import EncodingCheck

MAX_QUEUED_BYTES = 6 * 1024 * 1024  # 16 s of 48 kHz stereo floats
MAX_LIVE_S = 1.0  # a longer message is not from a microphone
CHUNK_S = 0.04  # duration of the chunks in which queued audio is forwarded
_END_TYPES = {WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR}


class AudioInput:
    """Forwards a client's audio to its session.

    If ``is_synthesized``, audio may arrive faster than real time. It is queued here and forwarded
    in real time, and an interruption drops the queue. Otherwise, only messages of more than a
    second are queued, with the messages that follow before the queue is empty.
    """

    def __init__(
        self, session: AudioSession, pcm_format: PcmFormat, *, is_synthesized: bool
    ) -> None:
        self.session = session
        self.pcm_format = pcm_format
        self._is_synthesized = is_synthesized
        self._is_first = True
        is_pcm16 = pcm_format.encoding == "s16le"
        self._encoding_check = EncodingCheck(pcm_format.num_channels) if is_pcm16 else None
        self._incomplete = b""  # part of a sample, or of a file's header
        self._drain_task: asyncio.Task[None] | None = None  # done when all audio is forwarded
        self._audio_limit = RealTimeLimit()
        self._command_limit = RealTimeLimit()
        self._queue = RealTimeQueue(session, pcm_format, keep_alive=is_synthesized)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Forward queued audio while the context is open, then drop the rest."""
        task = asyncio.create_task(self._queue.run())
        try:
            yield
        finally:
            task.cancel()
            self._queue.clear()

    async def push(self, pcm: bytes) -> None:
        """Forward the audio of a binary message of any length; return when more may be read.

        Raises ``UserError`` if the data does not have the announced format.
        """
        self.pcm_format.check_message(pcm)
        received = self._incomplete + pcm
        if self._is_first and len(received) < HEADER_BYTES:
            self._incomplete = received
            return
        await self._forward(received, message=received if self._is_first else pcm)

    async def _forward(self, pcm: bytes, message: bytes = b"") -> None:
        num_samples = len(pcm) // self.pcm_format.frame_bytes
        end = num_samples * self.pcm_format.frame_bytes
        pcm, self._incomplete = pcm[:end], pcm[end:]
        self.pcm_format.check_samples(pcm, is_first=self._is_first)
        if self._encoding_check is not None:
            self._encoding_check.check(message)
        self._is_first = False
        duration_s = num_samples / self.pcm_format.sample_rate_hz
        if self._is_synthesized or duration_s > MAX_LIVE_S or not self._queue.is_empty:
            await self._queue.put(pcm)
        else:
            self.session.send(pcm, num_samples)
            await self._audio_limit.wait(duration_s)

    def skip(self, num_samples: int) -> None:
        """Skip audio of the client after its audio so far: media time advances."""
        self._queue.skip(num_samples)

    async def flush(self) -> None:
        """Interrupt: drop queued audio, and audio whose face is not shown yet."""
        self._incomplete = b""
        self._queue.clear()
        await self.session.flush()

    async def end(self) -> None:
        """Mark the end of the audio: ``messages`` ends when the queue is empty."""
        await self._forward(self._incomplete)
        self._drain_task = asyncio.create_task(self._queue.wait_until_empty())

    async def messages(self, client: web.WebSocketResponse) -> AsyncIterator[WSMessage]:
        """Yield a client's messages until it disconnects; after ``end``, until all is forwarded."""
        while True:
            receiving = asyncio.create_task(client.receive())
            try:
                await asyncio.wait(
                    {receiving, self._drain_task} if self._drain_task else {receiving},
                    return_when=asyncio.FIRST_COMPLETED,
                )
                if not receiving.done():
                    return
            finally:
                receiving.cancel()  # does nothing if it is done
            message = receiving.result()
            if message.type in _END_TYPES:
                return
            if message.type is WSMsgType.TEXT:
                await self._command_limit.wait(COMMAND_S)
            yield message


class RealTimeQueue:
    """Queues audio that arrives early, and forwards it in real time."""

    def __init__(self, session: AudioSession, pcm_format: PcmFormat, *, keep_alive: bool) -> None:
        self._session = session
        self._format = pcm_format
        self._chunk_bytes = round(CHUNK_S * pcm_format.sample_rate_hz) * pcm_format.frame_bytes
        # interval between the silent chunks that keep a session without audio open
        self._keep_alive_s = session.idle_limit_s / 3 if keep_alive else None
        self._queued = bytearray()
        self._num_forwarded = 0  # bytes
        self._gaps = deque[tuple[int, int]]()  # bytes before skipped samples, number of samples
        self._not_empty = asyncio.Event()

    @property
    def is_empty(self) -> bool:
        """Whether all audio is forwarded."""
        return not self._queued

    async def put(self, pcm: bytes) -> None:
        """Wait until the queue has room, then add audio."""
        while self._queued and len(self._queued) + len(pcm) > MAX_QUEUED_BYTES:
            await asyncio.sleep(CHUNK_S)
        self._queued += pcm
        self._not_empty.set()

    def skip(self, num_samples: int) -> None:
        """Skip audio after the queued audio."""
        self._gaps.append((self._num_forwarded + len(self._queued), num_samples))
        self._skip_due()

    def clear(self) -> None:
        """Drop queued audio."""
        self._queued.clear()
        self._gaps.clear()

    async def wait_until_empty(self) -> None:
        """Return once all audio is forwarded."""
        while self._queued:
            await asyncio.sleep(CHUNK_S)

    async def run(self) -> None:
        """Forward queued audio until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            if not self._queued:
                await self._wait_for_audio()
                due_s = loop.time()
            end = self._chunk_bytes
            if self._gaps:
                end = min(end, self._gaps[0][0] - self._num_forwarded)
            chunk = bytes(self._queued[:end])
            del self._queued[:end]
            self._num_forwarded += len(chunk)
            try:
                self._session.send(chunk, len(chunk) // self._format.frame_bytes)
                self._skip_due()
            except KouxingError:  # the session has ended; its errors are reported elsewhere
                self.clear()
            due_s += len(chunk) / self._format.frame_bytes / self._format.sample_rate_hz
            await asyncio.sleep(due_s - loop.time())

    def _skip_due(self) -> None:
        while self._gaps and self._gaps[0][0] <= self._num_forwarded:
            self._session.skip(self._gaps.popleft()[1])

    async def _wait_for_audio(self) -> None:
        """Return once audio is queued. After a long pause, queue a chunk of silence."""
        self._not_empty.clear()
        try:
            await asyncio.wait_for(self._not_empty.wait(), self._keep_alive_s)
        except TimeoutError:
            self._queued += bytes(self._chunk_bytes)
