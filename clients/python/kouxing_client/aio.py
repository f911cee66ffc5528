"""The client for asyncio: as ``client``, and calls that wait there are awaited here."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar, cast

from kouxing_client.base import BaseClient, BaseResults, BaseSession, open_fields
from kouxing_client.client import LAST_ANSWER_S
from kouxing_client.errors import Refused
from kouxing_client.link import Link
from kouxing_client.messages import FapFrame, Fields, Phone, Result, Shapes
from kouxing_client.session_link import SessionLink
from kouxing_client.subscription import Subscription

Kind = TypeVar("Kind", bound=Result)


class AsyncSignal:
    """Wakes tasks of the event loop in which it is waited for first."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._event = asyncio.Event()

    def notify(self) -> None:
        """Wake all who wait."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the event loop is closed
                self._loop.call_soon_threadsafe(self._event.set)

    async def wait(self, condition: Callable[[], bool]) -> None:
        """Wait until a condition holds."""
        self._loop = asyncio.get_running_loop()
        while not condition():
            self._event.clear()
            if not condition():
                await self._event.wait()


class AsyncClient(BaseClient):
    """A connection to a running system; ``BaseClient`` has the parameters."""

    _make_signal = AsyncSignal

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections, as ``Client.close``."""
        await asyncio.to_thread(self._link.close)

    async def open_session(
        self,
        name: str = "",
        *,
        sample_rate_hz: int = 16000,
        num_channels: int = 1,
        encoding: str = "s16le",
        shapes: Sequence[str] = (),
        **options: object,
    ) -> AsyncSession:
        """Open a session, as ``Client.open_session``."""
        fields = open_fields(name, sample_rate_hz, num_channels, encoding, shapes, options)
        session = await asyncio.wrap_future(self._link.open(fields))
        return AsyncSession(self._link, session, fields)

    async def follow(self, name: str = "") -> AsyncSession:
        """Follow another program's session, as ``Client.follow``."""
        session = await asyncio.wrap_future(self._link.follow(name))
        return AsyncSession(self._link, session, None)

    async def request(self, kind: str, session: str = "", **fields: object) -> Fields:
        """Send any request, as ``Client.request``."""
        return await asyncio.wrap_future(self._link.request(kind, session, **fields))


class AsyncSession(BaseSession):
    """One session; ``BaseSession`` says what it does by itself."""

    def __init__(self, link: Link, session: SessionLink, options: Fields | None) -> None:
        super().__init__(link, session, options)
        self._signal = cast(AsyncSignal, session.signal)

    async def __aenter__(self) -> AsyncSession:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def push(self, audio: Any) -> None:
        """Send audio, as ``Session.push``."""
        for pcm, num_frames in self._chunks(audio):
            await self._signal.wait(self._has_room)
            self._add(pcm, num_frames)

    async def finish(self) -> None:
        """Say that no more audio comes, as ``Session.finish``."""
        self._finish()

    async def flush(self) -> None:
        """Interrupt, as ``Session.flush``."""
        await asyncio.wrap_future(self._flush())

    async def close(self) -> None:
        """Close the session, as ``Session.close``."""
        if not self._session.is_over and self._options is not None:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._signal.wait(self._is_delivered), LAST_ANSWER_S)
            with contextlib.suppress(Refused):  # it is closed already
                await asyncio.wrap_future(self._close())
        await asyncio.wrap_future(self._link.forget(self._session))

    async def frames(self) -> AsyncResults[FapFrame]:
        """Return the FAP frames from here on, as ``Session.frames``."""
        return await self._subscribe((FapFrame,))

    async def phones(self) -> AsyncResults[Phone]:
        """Return the phones from here on, as ``Session.phones``."""
        return await self._subscribe((Phone,))

    async def shapes(self, name: str) -> AsyncResults[Shapes]:
        """Return weights of blend shapes from here on, as ``Session.shapes``."""
        return await self._subscribe((Shapes,), name)

    async def results(self, *kinds: type[Result], shapes: str = "") -> AsyncResults[Result]:
        """Return results of several kinds from here on, as ``Session.results``."""
        return await self._subscribe(kinds, shapes)

    async def _subscribe(
        self, kinds: tuple[type[Result], ...], shapes: str = ""
    ) -> AsyncResults[Any]:
        subscription = self._session.subscribe(kinds, shapes)
        await asyncio.wrap_future(subscription.joined)
        if added := self._add_shapes(shapes):
            await asyncio.wrap_future(added)
        return AsyncResults(self._session, subscription)


class AsyncResults(BaseResults, Generic[Kind]):
    """Results of one session; iteration ends with the session's last face."""

    def __init__(self, session: SessionLink, subscription: Subscription) -> None:
        super().__init__(session, subscription)
        self._signal = cast(AsyncSignal, subscription.signal)

    def __aiter__(self) -> AsyncResults[Kind]:
        return self

    async def __anext__(self) -> Kind:
        await self._signal.wait(self._has_news)
        found = self._take()
        if found is None:
            raise StopAsyncIteration
        return cast(Kind, found)
