"""The asyncio client. It has the methods of ``Client``; those that block are coroutines."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from kouxing_client.base import LAST_ANSWER_S, BaseClient, BaseResults, BaseSession
from kouxing_client.errors import Refused
from kouxing_client.messages import Event, FapFrame, Fields, Phone, Result, Shapes, Status
from kouxing_client.options import FaceSettings, SessionOptions, face_fields, open_fields

if TYPE_CHECKING:
    from typing_extensions import Unpack

T = TypeVar("T", bound=Result | Event)


class AsyncClient(BaseClient):
    """A connection to a running system; ``BaseClient`` describes the parameters."""

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections, as ``Client.close``, and sessions whose opening was cancelled."""
        closings = [asyncio.wrap_future(closed) for closed in tuple(self._unused)]
        try:
            if closings:
                await asyncio.wait(closings, timeout=LAST_ANSWER_S)
        finally:
            await asyncio.to_thread(self._thread.close)

    async def open_session(self, name: str = "", **options: Unpack[SessionOptions]) -> AsyncSession:
        """Open a session, as ``Client.open_session``."""
        fields = open_fields(name, options)
        opened = self._thread.submit(lambda core: core.open_session(fields))
        try:
            return AsyncSession(self._thread, await asyncio.wrap_future(opened), fields)
        except asyncio.CancelledError:
            self._close_unused(opened)
            raise

    async def follow(self, name: str = "", *, paced: bool = True) -> AsyncSession:
        """Follow another program's session, as ``Client.follow``."""
        followed = self._thread.submit(lambda core: core.follow(name, is_paced=paced))
        return AsyncSession(self._thread, await asyncio.wrap_future(followed), None)

    async def status(self, session: str = "") -> Status:
        """Return the state of services and sessions, as ``Client.status``."""
        return await asyncio.wrap_future(self._thread.submit(lambda core: core.status(session)))

    async def set_face(self, session: str, **settings: Unpack[FaceSettings]) -> None:
        """Change the face of any session, as ``Client.set_face``."""
        await self.request("set-face", session, face=face_fields(settings))

    async def request(self, kind: str, session: str = "", **fields: object) -> Fields:
        """Send a request, as ``Client.request``."""
        return await asyncio.wrap_future(self._request(kind, session, fields))


class AsyncSession(BaseSession):
    """One session. ``BaseSession`` describes the common behavior."""

    async def __aenter__(self) -> AsyncSession:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def push(self, audio: Any) -> None:
        """Send audio, as ``Session.push``."""
        for pcm, num_samples in self._chunks(audio):
            await self._signal.wait_async(self._can_push)
            if not self._has_room():
                self._check()
            self._add(pcm, num_samples)

    async def finish(self) -> None:
        """End the audio, as ``Session.finish``."""
        self._finish()

    async def flush(self) -> None:
        """Interrupt the speech, as ``Session.flush``."""
        await asyncio.wrap_future(self._flush())

    async def set_face(self, **settings: Unpack[FaceSettings]) -> None:
        """Change the face, as ``Client.set_face``."""
        await asyncio.wrap_future(self._request("set-face", {"face": face_fields(settings)}))

    async def close(self) -> None:
        """Close the session, as ``Session.close``."""
        if self._core.has_ended:
            return
        try:
            if self._options is not None:
                delivered = self._signal.wait_async(self._is_delivered)
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(delivered, LAST_ANSWER_S)
                with contextlib.suppress(Refused):  # already closed
                    await asyncio.wrap_future(self._close())
        finally:
            await asyncio.wrap_future(self._thread.disconnect(self._core))

    async def frames(self) -> AsyncResults[FapFrame]:
        """Subscribe to FAP frames, as ``Session.frames``."""
        return await self._join((FapFrame,))

    async def phones(self) -> AsyncResults[Phone]:
        """Subscribe to phones, as ``Session.phones``."""
        return await self._join((Phone,))

    async def shapes(self, name: str) -> AsyncResults[Shapes]:
        """Subscribe to blendshape weights, as ``Session.shapes``."""
        return await self._join((Shapes,), name)

    async def results(
        self, *classes: type[Result], shapes: str = "", keep_all: bool = False
    ) -> AsyncResults[Any]:
        """Subscribe to results of several classes, as ``Session.results``."""
        return await self._join(classes, shapes, keep_all)

    def events(self) -> AsyncResults[Event]:
        """Subscribe to control's events about the session, as ``Session.events``."""
        return AsyncResults(*self._subscribe_events())

    async def _join(
        self, classes: tuple[type[Result], ...], shape_set: str = "", keep_all: bool = False
    ) -> AsyncResults[Any]:
        inbox, close, joined = self._subscribe(classes, shape_set, keep_all)
        try:
            await asyncio.wait_for(asyncio.wrap_future(joined), self._thread.timeout_s)
            if added := self._request_shapes(shape_set):
                await asyncio.wrap_future(added)
        except asyncio.TimeoutError:  # noqa: UP041 - another class in Python 3.10
            close()
            raise self._join_error() from None
        except BaseException:  # also a cancellation
            close()
            raise
        return AsyncResults(inbox, close)


class AsyncResults(BaseResults, Generic[T]):
    """Results of one session. Iteration ends with the session's last frame.

    At the end, it raises any error about the audio that no ``push`` or ``finish`` has raised.
    """

    def __aiter__(self) -> AsyncResults[T]:
        return self

    async def __anext__(self) -> T:
        while True:
            await self._signal.wait_async(self._has_results)
            if (result := self._take_or_fail()) is not None:
                return cast(T, result)
            if self.has_ended:  # otherwise another reader has taken the result
                raise StopAsyncIteration
