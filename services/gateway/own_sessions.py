"""The sessions that the gateway itself opens, as any other client does.

Sound comes in real time and cannot wait: what a full queue does not take is left out, and media
time goes on.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterator

from kouxing.services.gateway import wire
from kouxing.shared.client import Client, Refused, Session
from kouxing.shared.errors import UserError
from kouxing.shared.keys import Key

LAST_FRAME_LIMIT_S = 1.5  # for the last frames, when the sound ends
LAST_PHONES_S = 0.2  # for the last phones after the last frame: they take another way
CONTROL_LIMIT_S = 3.0  # for control's answers

Warn = Callable[[str, str, str], None]  # reason, text, session


class OwnSession:
    """One session that the gateway has open."""

    def __init__(self, session: Session, warn: Warn) -> None:
        self.name = session.name
        self.is_closed = False  # by control
        self._session = session
        self._warn = warn
        self._ended = asyncio.Event()  # no more frames come

    def send(self, pcm: bytes, num_frames: int) -> None:
        """Send sound that cannot wait, or leave it out if the recognizer is too slow."""
        if not self._session.send_pcm(pcm, num_frames):
            self.skip(num_frames)
            self._warn("slow_recognizer", "dropped audio: the recognizer is too slow", self.name)

    def skip(self, num_frames: int) -> None:
        """Leave sound out: media time goes on without it."""
        self._session.skip(num_frames)

    async def flush(self) -> None:
        """Interrupt: drop sound not yet shown."""
        await asyncio.to_thread(self._session.flush)

    async def choose_lips(self, lips: str) -> None:
        """Let another lip model move the mouth."""
        await asyncio.to_thread(self._session.choose_lips, lips)

    def errors(self) -> Iterator[Refused]:
        """Yield the recognizer's errors since the last call."""
        for error in self._session.errors():
            yield Refused(error.code, error.text)

    def end(self) -> None:
        """Take note that no more frames come."""
        self._ended.set()

    async def finish(self, limit_s: float) -> None:
        """Send no more; wait for the last frame, so long at most, and close the session."""
        if self.is_closed:
            return
        self._session.finish()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._ended.wait(), limit_s)
        await asyncio.sleep(LAST_PHONES_S)
        try:
            await asyncio.to_thread(self._session.close)
        except UserError as error:
            self._warn("close", str(error), self.name)


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
        self._open: dict[str, OwnSession] = {}

    @contextlib.asynccontextmanager
    async def open(
        self, last_frame_limit_s: float | None = None, **options: object
    ) -> AsyncIterator[OwnSession]:
        """Open a session; let its last frame come and close it in the end.

        Raises
        ------
        UserError
            If control refuses or does not answer.
        """
        client = Client(self._control, key=self._key, deadline_s=CONTROL_LIMIT_S)
        try:
            session = await asyncio.to_thread(client.open_session, **options)
            own = self._open[session.name] = OwnSession(session, self._warn)
            try:
                yield own
            finally:
                await own.finish(last_frame_limit_s or LAST_FRAME_LIMIT_S)
                del self._open[session.name]
        finally:
            await asyncio.to_thread(client.bus.close)

    def on_last_frame(self, session: str) -> None:
        """Take note that the last frame of a session has come."""
        if session in self._open:
            self._open[session].end()

    def on_closed(self, session: str) -> None:
        """Take note that control has closed a session."""
        if session in self._open:
            self._open[session].is_closed = True
            self._open[session].end()


def error_text(error: UserError) -> str:
    """Return the message for a browser about what went wrong."""
    if isinstance(error, Refused):
        return wire.error_text(error.text, error.code, retry_after_s(error))
    return wire.error_text(str(error))


def retry_after_s(error: UserError) -> float:
    """Return when it is worth trying again, in seconds; 0: nobody knows."""
    return error.retry_after_s if isinstance(error, Refused) else 0.0
