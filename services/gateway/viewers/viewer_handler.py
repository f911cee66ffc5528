"""Serves viewers: browsers that each show one session."""

import asyncio
import contextlib
import math
import socket
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from aiohttp import WSMsgType, web

from kouxing.services.gateway.audio.sample_sentence import SampleSentence
from kouxing.services.gateway.messages import browser_messages
from kouxing.services.gateway.messages.browser_messages import VIEWER_COMMANDS, ViewerCommand
from kouxing.services.gateway.messages.shape_messages import (
    ShapeEncoder,
    make_avatar_encoder,
    parse_shape_query,
)
from kouxing.services.gateway.viewers.viewer_queue import MessageKind, ViewerQueue
from kouxing.services.gateway.web.limits import COMMAND_S, ConnectionQuota, RealTimeLimit
from kouxing.services.gateway.web.web_application import OpenWebSockets
from kouxing.shared.errors import UserError
from kouxing.shared.face.idle_motion import RestingFace
from kouxing.shared.monitoring.metrics import Metrics
from kouxing.shared.name_rules import NAME_RULE, is_name
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.speech import AcousticModelName

MAX_VIEWERS = 64
WRITE_BUFFER_BYTES = 4096  # in this process
SEND_BUFFER_BYTES = 32 * 1024  # in the kernel; about half a second for a slow viewer
PAUSE_S = 0.2  # after this time without a frame, a viewer receives the face at rest


@dataclass(slots=True)
class _ShownSession:
    epoch: int
    face: FaceSettings
    language: str  # its code; empty: unknown
    acoustic: str = AcousticModelName.FULL


_NO_SESSION = _ShownSession(epoch=0, face=FaceSettings(), language="", acoustic="")


@dataclass(slots=True, eq=False)
class Viewer:
    """One browser that shows a session."""

    requested_session: str  # empty: the newest
    shape_encoder: ShapeEncoder | None  # encodes frames as blendshapes, in addition to FAPs
    sample_session: str = ""  # shown instead until the sample sentence has ended
    queue: ViewerQueue = field(default_factory=ViewerQueue)
    shown_session: tuple[str, int] | None = None  # session and epoch
    # session and epoch, or only the name of a session that does not exist
    last_announced: tuple[str, int] | str = ""
    has_resting_face: bool = False  # whether it has the face at rest, from which its player starts
    last_frame_s: float = -math.inf  # when the newest frame was sent

    @property
    def chosen_session(self) -> str:
        """The session to show; empty: the newest."""
        return self.sample_session or self.requested_session

    @property
    def shown_name(self) -> str:
        """Name of the shown session; empty if no session is shown."""
        return self.shown_session[0] if self.shown_session is not None else ""


class ViewerHandler:
    """Sends every viewer the messages of its requested session, or of the newest session.

    The session of the sample sentence counts as the newest only if no other session is open.
    ``set_face`` sends control the settings of a session's face, or of the face at rest ("").
    ``on_connected`` is called for each new viewer.
    """

    def __init__(
        self,
        web_sockets: OpenWebSockets,
        address_share: float,
        metrics: Metrics,
        sample: SampleSentence,
        set_face: Callable[[str, FaceSettings], None],
        on_connected: Callable[[], None],
    ) -> None:
        self._web_sockets = web_sockets
        self._quota = ConnectionQuota(MAX_VIEWERS, "viewers", address_share)
        self._metrics = metrics
        self._sample = sample
        self._set_face = set_face
        self._on_connected = on_connected
        self._viewers: set[Viewer] = set()
        self._sessions: dict[str, _ShownSession] = {}  # in order of opening
        self._missing: tuple[str, ...] = ("control",)

    # --- sessions ------------------------------------------------------------------------------

    def add_session(self, session: str, epoch: int, face: FaceSettings, language: str) -> None:
        """Announce a session to its viewers, or its new epoch."""
        known = self._sessions.get(session)
        self._sessions[session] = shown = _ShownSession(epoch, face, language)
        if known is not None:  # a recognizer that did not move does not repeat its model
            shown.acoustic = known.acoustic
        self._notify_viewers()

    def change_face(self, session: str, change: FaceSettings) -> None:
        """Change the face of a session, and announce it if viewers show the changed settings."""
        if session in self._sessions:
            shown_session = self._sessions[session]
            before = _shown_settings(shown_session.face)
            shown_session.face = shown_session.face.merged_with(change)
            settings = _shown_settings(shown_session.face)
            if settings != before:
                self.forward(
                    session, MessageKind.FACE, browser_messages.encode_json("face", **settings)
                )

    def announce_acoustic_model(self, session: str, model: str) -> None:
        """Announce the acoustic model of a session, if it has changed."""
        shown_session = self._sessions.get(session)
        if shown_session is not None and shown_session.acoustic != model:
            shown_session.acoustic = model
            self.forward(
                session,
                MessageKind.ACOUSTIC,
                browser_messages.encode_json("acoustic", acoustic=model),
            )

    def remove_session(self, session: str) -> None:
        """Announce to a session's viewers that it has ended."""
        self._sessions.pop(session, None)
        self._notify_viewers()

    def announce_missing_services(self, missing: tuple[str, ...]) -> None:
        """Announce which services are not running, if this has changed."""
        if missing != self._missing:
            self._missing = missing
            for viewer in self._viewers:
                self._put(viewer, MessageKind.STATUS, self._status())

    def forward(self, session: str, kind: MessageKind, message: str | bytes) -> None:
        """Send a message to the viewers of a session."""
        for viewer in self._viewers_of(session):
            self._put(viewer, kind, message)

    def show_frame(
        self, session: str, epoch: int, media_time: int, faps: bytes, now_s: float
    ) -> None:
        """Send a frame to the viewers of a session."""
        message = browser_messages.encode_binary(browser_messages.FAP_TYPE, epoch, media_time, faps)
        viewers = self._viewers_of(session)
        for viewer in viewers:
            viewer.last_frame_s = now_s
            self._put(viewer, MessageKind.FRAME, message)
        self._put_shapes(viewers, MessageKind.SHAPES, "weights", epoch, media_time, faps)

    def show_resting_face(self, face: RestingFace, now_s: float) -> None:
        """Send the face at rest to new viewers, and to viewers without recent frames."""
        viewers = [viewer for viewer in self._viewers if now_s >= _resting_frame_due_s(viewer)]
        faps = face.faps(now_s).astype("<f4").tobytes()
        message = browser_messages.encode_binary(browser_messages.REST_TYPE, 0, 0, faps)
        for viewer in viewers:
            viewer.has_resting_face = True
            self._put(viewer, MessageKind.REST, message)
        self._put_shapes(viewers, MessageKind.REST_SHAPES, "rest", 0, 0, faps)

    @property
    def resting_frame_due_s(self) -> float:
        """When the face at rest is due for the first viewer; infinite without viewers."""
        return min(map(_resting_frame_due_s, self._viewers), default=math.inf)

    @property
    def newest_session(self) -> str:
        """The session shown to viewers that requested none; empty if there is no session."""
        samples = self._sample.open_sessions
        others = (name for name in reversed(self._sessions) if name not in samples)
        return next(others, samples[-1] if samples else "")

    @property
    def shown_sessions(self) -> Iterator[str]:
        """The sessions that viewers see."""
        return (viewer.shown_name for viewer in self._viewers if viewer.shown_name)

    # --- viewers -------------------------------------------------------------------------------

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Serve one viewer until it disconnects."""
        chosen_session = request.query.get("session", "")
        if chosen_session and not is_name(chosen_session):
            raise web.HTTPBadRequest(text=f"session must be a name; {NAME_RULE}\n")
        shape_encoder = parse_shape_query(request.query)
        async with self._web_sockets.open(request, self._quota) as browser:
            _limit_send_buffers(request)
            with self.connect_viewer(chosen_session, shape_encoder) as viewer:
                await self._serve_commands(viewer, browser)
        return browser

    @contextlib.contextmanager
    def connect_viewer(self, session: str, shape_encoder: ShapeEncoder | None) -> Iterator[Viewer]:
        """Add a viewer while the context is open. The caller sends the messages in its queue."""
        viewer = Viewer(session, shape_encoder)
        self._viewers.add(viewer)
        self._on_connected()
        try:
            self._put(viewer, MessageKind.STATUS, self._status())
            if shape_encoder is not None:
                self._put(viewer, MessageKind.SHAPE_NAMES, shape_encoder.header_message())
            self._notify_viewer(viewer)
            yield viewer
        finally:
            self._viewers.discard(viewer)

    async def _serve_commands(self, viewer: Viewer, browser: web.WebSocketResponse) -> None:
        writer = asyncio.create_task(_write(browser, viewer.queue))
        rate_limit = RealTimeLimit()
        try:
            async for message in browser:
                if message.type is WSMsgType.ERROR:
                    break  # the connection is closed; the data is an exception
                if message.type is WSMsgType.TEXT:
                    self.handle_command(viewer, message.data)
                num_kib = len(message.data) >> 10  # long names of an avatar take time to find
                await rate_limit.wait(COMMAND_S * (1 + num_kib))
        finally:
            writer.cancel()

    def handle_command(self, viewer: Viewer, message: str) -> None:
        """Execute a viewer's command, or send the viewer an error."""
        try:
            command = browser_messages.parse_viewer_command(message)
            if command.problem:
                self._put_error(viewer, command.problem)
            self._execute(viewer, command)
        except UserError as error:
            self._put_error(viewer, str(error))
        self._notify_viewer(viewer)

    def _execute(self, viewer: Viewer, command: ViewerCommand) -> None:
        lip_model = command.face.lip_model if command.face is not None else None
        _check_single(command, lip_model)
        if command.play is not None:
            self._sample.play(lip_model or "", self._on_sample_end)
            viewer.sample_session = self._sample.session
        elif lip_model:
            if viewer.chosen_session not in self._sample.open_sessions:
                raise UserError("a viewer can set lip_model only for the sample sentence")
            self._sample.lip_model = lip_model
        elif command.face is not None:
            if viewer.shown_session is None and command.face.expressions is None:
                raise UserError("no session is shown; start a microphone or the sample first")
            uses_light_model = command.face.acoustic == AcousticModelName.LIGHT
            shown = self._sessions.get(viewer.shown_name)
            if uses_light_model and shown is not None and shown.language != load_inventory().code:
                raise UserError("the light model has only Mandarin; show a session in Mandarin")
            self._set_face(viewer.shown_name, command.face)
        elif command.follow is not None:
            viewer.requested_session, viewer.sample_session = command.follow, ""
        elif command.avatar is not None:
            viewer.shape_encoder = make_avatar_encoder(command.avatar, command.format)
            self._put(viewer, MessageKind.SHAPE_NAMES, viewer.shape_encoder.header_message())
        elif not command.problem:
            names = ", ".join(VIEWER_COMMANDS)
            raise UserError(f"the message contains no command; send one of {names}")

    def _on_sample_end(self, session: str, error: str) -> None:
        """Show the requested session again to viewers of the sample sentence, with the error."""
        for viewer in self._viewers:
            if viewer.sample_session == session:
                viewer.sample_session = ""
                if error:
                    self._put(viewer, MessageKind.TEXT, error)
        self._notify_viewers()

    def _notify_viewers(self) -> None:
        for viewer in self._viewers:
            self._notify_viewer(viewer)

    def _notify_viewer(self, viewer: Viewer) -> None:
        """Announce the session that the viewer sees, or that none exists, if it has changed."""
        name = viewer.chosen_session or self.newest_session
        exists = name in self._sessions
        session = self._sessions.get(name, _NO_SESSION)
        viewer.shown_session = (name, session.epoch) if exists else None
        announced = viewer.shown_session or viewer.chosen_session
        if announced == viewer.last_announced:
            return
        viewer.last_announced = announced
        is_sample = exists and name in self._sample.open_sessions
        message = browser_messages.encode_json(
            "session",
            session=name if exists else None,
            chosen=viewer.chosen_session,
            epoch=session.epoch,
            **_shown_settings(session.face),
            language=session.language,
            acoustic=session.acoustic,
            sample=is_sample and name == viewer.chosen_session,
        )
        self._put(viewer, MessageKind.SESSION, message)

    def _viewers_of(self, session: str) -> list[Viewer]:
        return [viewer for viewer in self._viewers if viewer.shown_name == session]

    def _put_shapes(
        self,
        viewers: Iterable[Viewer],
        kind: MessageKind,
        message_type: str,
        epoch: int,
        media_time: int,
        faps: bytes,
    ) -> None:
        """Send a frame as blendshapes to the viewers that asked for them."""
        messages: dict[ShapeEncoder, str | bytes] = {}
        for viewer in viewers:
            if (encoder := viewer.shape_encoder) is not None:
                if encoder not in messages:
                    messages[encoder] = encoder.encode(message_type, epoch, media_time, faps)
                self._put(viewer, kind, messages[encoder])

    def _put(self, viewer: Viewer, kind: MessageKind, message: str | bytes) -> None:
        num_dropped = viewer.queue.put(kind, message)
        if num_dropped:
            self._metrics.count("dropped_slow_viewer", num_dropped)

    def _put_error(self, viewer: Viewer, text: str) -> None:
        self._put(viewer, MessageKind.TEXT, browser_messages.encode_error(text))

    def _status(self) -> str:
        return browser_messages.encode_json("status", missing=self._missing)


def _shown_settings(face: FaceSettings) -> dict[str, object]:
    return {
        "lip_model": face.lip_model or "",
        "expressiveness": face.expressiveness,
        "feeling": face.feeling,
    }


def _check_single(command: ViewerCommand, lip_model: str | None) -> None:
    """Raise ``UserError`` if a command has more than one effect."""
    effects = (
        command.follow is not None,
        command.play is not None or lip_model is not None,
        command.avatar is not None,
        command.face not in (None, FaceSettings(lip_model=lip_model)),
    )
    if sum(effects) > 1:
        raise UserError(
            "follow, play (with lip_model), avatar and other settings of the face cannot be"
            " combined; send a message for each"
        )


def _resting_frame_due_s(viewer: Viewer) -> float:
    """Return when the face at rest is due for a viewer."""
    return viewer.last_frame_s + PAUSE_S if viewer.has_resting_face else -math.inf


def _limit_send_buffers(request: web.Request) -> None:
    """Limit the buffers of a slow viewer, so that its queue fills up and drops old messages."""
    if (transport := request.transport) is not None:
        transport.set_write_buffer_limits(WRITE_BUFFER_BYTES)
        raw = transport.get_extra_info("socket")
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)


async def _write(browser: web.WebSocketResponse, queue: ViewerQueue) -> None:
    with contextlib.suppress(ConnectionError):
        while True:
            message = await queue.get()
            if isinstance(message, str):
                await browser.send_str(message)
            else:
                await browser.send_bytes(message)
