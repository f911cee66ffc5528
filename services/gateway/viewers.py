"""The browsers that look on: which session each of them sees, and what is sent to it."""

from __future__ import annotations

import asyncio
import contextlib
import re
import socket
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from aiohttp import WSMsgType, web

from kouxing.services.gateway import wire
from kouxing.services.gateway.http import WebSockets
from kouxing.services.gateway.outbox import Kind, Outbox
from kouxing.services.gateway.pace import COMMAND_S, Pace
from kouxing.services.gateway.places import Places
from kouxing.services.gateway.shape_view import ShapeView, parse_shape_view
from kouxing.shared.errors import UserError
from kouxing.shared.metrics import Metrics

MAX_VIEWERS = 64
SEND_BUFFER_BYTES = 64 * 1024  # what the kernel may hold for a slow viewer, about a second
_SESSION = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass(slots=True)
class _Session:
    epoch: int
    lips: str  # the lip model that moves the mouth; empty: not known


@dataclass(slots=True, eq=False)
class Viewer:
    """One browser that looks on."""

    chosen: str  # the session it asked for; empty: the newest
    shapes: ShapeView | None  # that it gets beside FAP frames
    outbox: Outbox = field(default_factory=Outbox)
    shown: tuple[str, int] | None = None  # session and epoch that it was notified of last


class Viewers:
    """Sends each viewer the session that it asked for, or the newest.

    Parameters
    ----------
    web_sockets
        Opens the browsers' connections.
    share
        Of the places, for one address.
    metrics
        Counts what slow viewers lose.
    play_sample
        Starts to speak the sample sentence with a lip model, unless it is being spoken; returns its
        session, which counts as the newest only if there is no other.
    choose_sample_lips
        Lets another lip model move the mouth while the sample sentence is spoken.
    express
        Lets the face of a session show expressions.
    choose_expressiveness
        Lets the mouth of a session move more or less.
    """

    def __init__(
        self,
        web_sockets: WebSockets,
        share: float,
        metrics: Metrics,
        play_sample: Callable[[str], str],
        choose_sample_lips: Callable[[str], None],
        express: Callable[[str, wire.Expressions], None],
        choose_expressiveness: Callable[[str, float], None],
    ) -> None:
        self._web_sockets = web_sockets
        self._places = Places(MAX_VIEWERS, "viewers", share)
        self._metrics = metrics
        self._play_sample = play_sample
        self._choose_sample_lips = choose_sample_lips
        self._express = express
        self._choose_expressiveness = choose_expressiveness
        self._viewers: set[Viewer] = set()
        self._sessions: dict[str, _Session] = {}  # in the order they were opened
        self._sample = ""  # the session of the sample sentence, while it is spoken
        self._missing: tuple[str, ...] = ("control",)

    def add_session(self, session: str, epoch: int, lips: str) -> None:
        """Show a session to whom it concerns; again when it goes on in another epoch."""
        self._sessions[session] = _Session(epoch, lips)
        self._notify_viewers()

    def set_lips(self, session: str, lips: str) -> None:
        """Say that another lip model moves the mouth of a session."""
        if session in self._sessions:
            self._sessions[session].lips = lips
            self.forward(session, Kind.TEXT, wire.text("lips", lips=lips))

    def remove_session(self, session: str) -> None:
        """Show a session no longer."""
        self._sessions.pop(session, None)
        self._notify_viewers()

    def end_sample(self, error: str = "") -> None:
        """Let those who asked for the sample sentence see the newest session again.

        Parameters
        ----------
        error
            An error message for them, if the sentence could not be spoken.
        """
        for viewer in self._viewers:
            if self._sample and viewer.chosen == self._sample:
                viewer.chosen = ""
                if error:
                    self._put(viewer, Kind.TEXT, error)
        self._sample = ""
        self._notify_viewers()

    def set_missing(self, missing: tuple[str, ...]) -> None:
        """Tell every viewer which services do not run, if these are others than before."""
        if missing != self._missing:
            self._missing = missing
            for viewer in self._viewers:
                self._put(viewer, Kind.TEXT, self._status())

    def forward(self, session: str, kind: Kind, message: str | bytes) -> None:
        """Send a message to the viewers of a session."""
        for viewer in self._viewers_of(session):
            self._put(viewer, kind, message)

    def show_frame(self, session: str, epoch: int, media_time: int, faps: bytes) -> None:
        """Send the viewers of a session a frame of its face."""
        message = wire.binary(wire.FAP_TYPE, epoch, media_time, faps)
        self.forward(session, Kind.FRAME, message)
        viewers = self._viewers_of(session)
        self._put_shapes(viewers, Kind.SHAPES, "weights", epoch, media_time, faps)

    @property
    def newest(self) -> str:
        """The session that is shown to who chose none; empty if there is none."""
        names = (name for name in reversed(self._sessions) if name != self._sample)
        return next(names, self._sample)

    @property
    def is_anybody_there(self) -> bool:
        """Whether a browser is connected."""
        return bool(self._viewers)

    def show_rest(self, faps: bytes) -> None:
        """Send every viewer the face at rest, which is seen while no session moves it."""
        message = wire.binary(wire.REST_TYPE, 0, 0, faps)
        for viewer in self._viewers:
            self._put(viewer, Kind.REST, message)
        self._put_shapes(self._viewers, Kind.REST_SHAPES, "rest", 0, 0, faps)

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Serve one viewer until it leaves."""
        chosen = request.query.get("session", "")
        if chosen and not _SESSION.fullmatch(chosen):
            raise web.HTTPBadRequest(text="session: up to 64 letters, digits, '-' and '_'\n")
        try:
            shapes = parse_shape_view(request.query)
        except UserError as error:
            raise web.HTTPBadRequest(text=f"{error}\n") from None
        viewer = Viewer(chosen, shapes)
        self._viewers.add(viewer)
        try:
            async with self._web_sockets.accept(request, self._places) as browser:
                _limit_send_buffer(request)
                self._welcome(viewer)
                await self._converse(viewer, browser)
        finally:
            self._viewers.discard(viewer)
        return browser

    @contextlib.contextmanager
    def join(self, session: str, shapes: ShapeView | None) -> Iterator[Outbox]:
        """Let somebody look at a session who is sent messages by other means."""
        viewer = Viewer(session, shapes)
        self._viewers.add(viewer)
        try:
            self._welcome(viewer)
            yield viewer.outbox
        finally:
            self._viewers.discard(viewer)

    async def _converse(self, viewer: Viewer, browser: web.WebSocketResponse) -> None:
        writer = asyncio.create_task(_write(browser, viewer.outbox))
        pace = Pace()
        try:
            async for message in browser:
                if message.type is WSMsgType.TEXT:
                    self._handle_command(viewer, message.data)
                await pace.keep(COMMAND_S)
        finally:
            writer.cancel()

    def _handle_command(self, viewer: Viewer, message: str) -> None:
        try:
            command = wire.parse_object(message)
            session = command.get("follow")
            lips = wire.parse_lips(command)
            expressions = wire.parse_expressions(command)
            amount = wire.parse_expressiveness(command)
            if command.get("play") == "sample":
                self._sample = viewer.chosen = self._play_sample(lips)
            elif expressions is not None:
                if viewer.shown is None:
                    raise UserError("no session is shown whose face could express anything")
                self._express(viewer.shown[0], expressions)
            elif amount is not None:
                if viewer.shown is None:
                    raise UserError("no session is shown whose mouth could move more or less")
                self._choose_expressiveness(viewer.shown[0], amount)
            elif lips:
                if not self._sample or viewer.chosen != self._sample:
                    raise UserError("lips can be chosen here only for the sample sentence")
                self._choose_sample_lips(lips)
            elif isinstance(session, str) and (not session or _SESSION.fullmatch(session)):
                viewer.chosen = session
            else:
                raise UserError(
                    "expected 'follow' with a session's name, 'play', 'lips', 'express' "
                    "or 'expressiveness'"
                )
        except UserError as error:
            self._put(viewer, Kind.TEXT, wire.error_text(str(error)))
        self._notify_viewer(viewer)

    def _welcome(self, viewer: Viewer) -> None:
        self._put(viewer, Kind.TEXT, self._status())
        if viewer.shapes is not None:
            self._put(viewer, Kind.TEXT, viewer.shapes.hello())
        self._notify_viewer(viewer)

    def _notify_viewers(self) -> None:
        for viewer in self._viewers:
            self._notify_viewer(viewer)

    def _notify_viewer(self, viewer: Viewer) -> None:
        """Say which session the viewer sees now, if it is another than before."""
        name = viewer.chosen or self.newest
        session = self._sessions.get(name)
        shown = (name, session.epoch) if session else None
        if shown != viewer.shown:
            viewer.shown = shown
            message = wire.text(
                "session",
                session=name if session else None,
                chosen=viewer.chosen,
                epoch=session.epoch if session else 0,
                lips=session.lips if session else "",
                sample=session is not None and name == viewer.chosen == self._sample,
            )
            self._put(viewer, Kind.TEXT, message)

    def _viewers_of(self, session: str) -> list[Viewer]:
        return [each for each in self._viewers if each.shown and each.shown[0] == session]

    def _put_shapes(
        self,
        viewers: Iterable[Viewer],
        kind: Kind,
        shown: str,
        epoch: int,
        media_time: int,
        faps: bytes,
    ) -> None:
        """Send the viewers that asked for shapes a frame in these."""
        messages: dict[ShapeView, str | bytes] = {}
        for viewer in viewers:
            if (view := viewer.shapes) is not None:
                if view not in messages:
                    messages[view] = view.message(shown, epoch, media_time, faps)
                self._put(viewer, kind, messages[view])

    def _put(self, viewer: Viewer, kind: Kind, message: str | bytes) -> None:
        num_dropped = viewer.outbox.put(kind, message)
        if num_dropped:
            self._metrics.count("dropped_slow_viewer", num_dropped)

    def _status(self) -> str:
        return wire.text("status", missing=self._missing)


def _limit_send_buffer(request: web.Request) -> None:
    raw = request.transport.get_extra_info("socket") if request.transport else None
    if raw is not None:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)


async def _write(browser: web.WebSocketResponse, outbox: Outbox) -> None:
    with contextlib.suppress(ConnectionError):
        while True:
            message = await outbox.get()
            if isinstance(message, str):
                await browser.send_str(message)
            else:
                await browser.send_bytes(message)
