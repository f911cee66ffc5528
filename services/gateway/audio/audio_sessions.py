"""Opens sessions for audio from microphones, WebRTC and the sample sentence.

Audio arrives in real time and cannot wait. If the recognizer is too slow, audio is dropped. Media
time continues.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

from kouxing_client import AsyncClient, AsyncSession, KouxingError, Refused
from kouxing_client.keys import Key

from kouxing.services.gateway.messages import browser_messages
from kouxing.shared.errors import UserError

LAST_FRAME_TIMEOUT_S = 1.5  # maximum wait for the last frame after the end of the audio
LAST_PHONES_WAIT_S = 0.2  # wait for the last phones, which arrive separately from the last frame
CONTROL_START_S = 3.0  # wait until control must have started
# Control needs up to 5 s to open a session if it has just restarted, or if a service hangs.
CONTROL_TIMEOUT_S = 10.0

Warn = Callable[[str, str, str], None]  # reason, text, session


class AudioSession:
    """One session that the gateway has opened.

    Control closes it after ``idle_limit_s`` without audio.
    """

    def __init__(self, session: AsyncSession, warn: Warn, idle_limit_s: float) -> None:
        self.name = session.name
        self.idle_limit_s = idle_limit_s
        self.is_closed = False  # control has closed it
        self._session = session
        self._warn = warn
        self.frames_ended = asyncio.Event()  # set when no more frames will arrive

    def send(self, pcm: bytes, num_samples: int) -> None:
        """Send ``num_samples`` samples per channel; drop them if the recognizer is too slow.

        Raises ``KouxingError`` if the session has ended.
        """
        if not self.is_closed and not self._session.try_push(pcm):
            self.skip(num_samples)
            self._warn("slow_recognizer", "dropped audio: the recognizer cannot keep up", self.name)

    def skip(self, num_samples: int) -> None:
        """Skip audio: media time advances. If the session has ended, this does nothing."""
        with contextlib.suppress(KouxingError):
            self._session.skip(num_samples)

    async def flush(self) -> None:
        """Interrupt: drop audio whose face is not shown yet."""
        await self._session.flush()

    async def set_face(self, **settings: object) -> None:
        """Change settings of the face."""
        await self._session.set_face(**settings)  # type: ignore[arg-type]

    def take_errors(self) -> list[Refused]:
        """Return the recognizer's errors since the last call.

        Raises ``KouxingError`` if the session has ended.
        """
        return [] if self.is_closed else self._session.take_errors()

    async def finish(self) -> None:
        """Stop sending, wait for the last frame, then close the session."""
        try:
            if not self.is_closed:
                await self._session.finish()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self.frames_ended.wait(), LAST_FRAME_TIMEOUT_S)
                await asyncio.sleep(LAST_PHONES_WAIT_S)
        except KouxingError as error:
            self._warn("close", str(error), self.name)
        try:
            await self._session.close()
        except KouxingError as error:
            self._warn("close", str(error), self.name)


class AudioClient:
    """Opens sessions as a client of control. Without a ``key``, nothing is encrypted."""

    def __init__(self, control: str, key: Key | None, warn: Warn) -> None:
        self._control = control
        self._key = key
        self._warn = warn
        self._client: AsyncClient | None = None
        self._open: dict[str, AudioSession] = {}
        self.num_opening = 0  # sessions that control has not confirmed yet
        self.idle_limit_s = 60.0  # of control; updated by its heartbeats

    @contextlib.asynccontextmanager
    async def open(self, session: str = "", **options: object) -> AsyncIterator[AudioSession]:
        """Open a session; on leaving, wait for its last frame and close it.

        Raises ``KouxingError`` if control rejects the session or does not answer.
        """
        if self._client is None or self._client.is_closed:
            self._client = AsyncClient(
                self._control,
                key=self._key,
                insecure=self._key is None,
                timeout_s=CONTROL_TIMEOUT_S,
                start_s=CONTROL_START_S,
            )
        self.num_opening += 1
        try:
            opened = AudioSession(
                await self._client.open_session(session, **options),  # type: ignore[arg-type]
                self._warn,
                self.idle_limit_s,
            )
        finally:
            self.num_opening -= 1
        self._open[opened.name] = opened
        try:
            yield opened
        finally:
            try:
                await opened.finish()
            finally:  # also if this task is cancelled
                del self._open[opened.name]

    async def close(self) -> None:
        """Disconnect from control."""
        if self._client is not None:
            await self._client.close()

    def on_last_frame(self, session: str) -> None:
        """Record that the last frame of a session has arrived."""
        if session in self._open:
            self._open[session].frames_ended.set()

    def on_closed(self, session: str) -> None:
        """Record that control has closed a session."""
        if session in self._open:
            self._open[session].is_closed = True
            self._open[session].frames_ended.set()


def error_text(error: UserError | KouxingError) -> str:
    """Return the message about an error for a browser."""
    if isinstance(error, Refused):
        return browser_messages.encode_error(error.text, error.code, error.retry_after_s)
    return browser_messages.encode_error(str(error))
