"""WHIP (RFC 9725): WebRTC by one POST. Sound comes as a track, frames go by a data channel.

Each client has a session of its own. Its data channel gets what a viewer of that session gets,
but the sound, and takes the commands of a microphone.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import math
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from aiohttp import web

from kouxing.services.gateway import wire
from kouxing.services.gateway.outbox import Kind
from kouxing.services.gateway.own_sessions import OwnSession, OwnSessions, error_text, retry_after_s
from kouxing.services.gateway.pace import COMMAND_S, Pace
from kouxing.services.gateway.places import Places
from kouxing.services.gateway.shape_view import ShapeView, parse_shape_view
from kouxing.services.gateway.viewers import Viewers
from kouxing.shared.errors import UserError
from kouxing.shared.logs import LOG

if TYPE_CHECKING:
    from aiortc import RTCDataChannel

    from kouxing.services.gateway.webrtc import Peer

MAX_CLIENTS = 16
SDP = "application/sdp"
MAX_COMMANDS = 100  # of one client that wait
MAX_BUFFERED_BYTES = 64 * 1024  # of a data channel; then messages wait, and old frames are dropped
BUFFER_WAIT_S = 0.02
MISSING = (
    "this gateway has no WebRTC; for that type in kouxing's folder, where the gateway runs: "
    ".venv/bin/pip install 'kouxing[webrtc]'\n"
)


@dataclass(slots=True, eq=False)
class _Client:
    shapes: ShapeView | None  # that it gets beside FAP frames
    place: contextlib.ExitStack  # holds it
    peer: Peer | None = None
    session: OwnSession | None = None
    is_ending: bool = False  # the session's end is our own
    tasks: set[asyncio.Task[None]] = field(default_factory=set)  # of its data channels


class WhipClients:
    """Streams the sound of each WebRTC client into a session of its own.

    Parameters
    ----------
    share
        Of the places, for one address.
    own_sessions
        Opens the sessions.
    viewers
        Know what to show of a session.
    addresses
        Of this machine, at which clients may connect; none: all but loopback.
    """

    def __init__(
        self,
        share: float,
        own_sessions: OwnSessions,
        viewers: Viewers,
        addresses: Sequence[str],
    ) -> None:
        self._places = Places(MAX_CLIENTS, "WebRTC clients", share)
        self._own_sessions = own_sessions
        self._viewers = viewers
        self._addresses = addresses
        self._open: dict[str, _Client] = {}  # by the names of their resources
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_closing = False

    def __len__(self) -> int:
        return len(self._open)

    async def serve_offer(self, request: web.Request) -> web.StreamResponse:
        """Answer an offer."""
        if request.content_type != SDP:
            raise web.HTTPUnsupportedMediaType(text=f"expected an SDP offer ({SDP})\n")
        offer = (await request.read()).decode(errors="replace")
        if self._is_closing:
            raise web.HTTPServiceUnavailable(text="the gateway stops\n")
        try:
            shapes = parse_shape_view(request.query)
        except UserError as error:
            raise web.HTTPBadRequest(text=f"{error}\n") from None
        place = contextlib.ExitStack()
        place.enter_context(self._places.held(request))
        name, client = secrets.token_urlsafe(12), _Client(shapes, place)
        self._open[name] = client
        try:
            client.peer = await self._make_peer(client)
            answer = await client.peer.answer(offer)
        except UserError as error:
            await self._drop(name)
            raise web.HTTPUnprocessableEntity(text=f"{error}\n") from None
        except BaseException:
            await self._drop(name)
            raise
        opened: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        task = asyncio.create_task(self._stream(name, client, client.peer, opened))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        try:
            await opened
        except UserError as error:
            wait_s = retry_after_s(error)
            headers = {"Retry-After": str(math.ceil(wait_s))} if wait_s else {}
            raise web.HTTPServiceUnavailable(text=f"{error}\n", headers=headers) from None
        headers = {"Location": f"{request.path}/{name}"}
        return web.Response(status=201, text=answer, content_type=SDP, headers=headers)

    async def serve_end(self, request: web.Request) -> web.StreamResponse:
        """End a client's connection."""
        client = self._open.get(request.match_info["name"])
        if client is None or client.peer is None:
            raise web.HTTPNotFound
        await client.peer.close()
        return web.Response()

    async def close_session(self, session: str) -> None:
        """End the connection of a session, if there is one, that control has closed."""
        for client in [*self._open.values()]:
            is_its = client.session is not None and client.session.name == session
            if is_its and not client.is_ending and client.peer is not None:
                await client.peer.close()

    async def close_all(self) -> None:
        """End every connection, and take no more."""
        self._is_closing = True
        peers = [client.peer for client in self._open.values() if client.peer is not None]
        await asyncio.gather(*(peer.close() for peer in peers), return_exceptions=True)

    async def _make_peer(self, client: _Client) -> Peer:
        try:
            webrtc = await asyncio.to_thread(
                importlib.import_module, "kouxing.services.gateway.webrtc"
            )
        except ModuleNotFoundError:
            raise web.HTTPNotImplemented(text=MISSING) from None
        if self._addresses:
            webrtc.use_addresses(self._addresses)
        peer: Peer = webrtc.Peer(lambda channel: self._on_channel(client, channel))
        return peer

    async def _stream(
        self, name: str, client: _Client, peer: Peer, opened: asyncio.Future[None]
    ) -> None:
        """Open a session for a client, and stream its sound until it leaves."""
        try:
            async with self._own_sessions.open(
                encoding="s16le", sample_rate_hz=peer.rate_hz, num_channels=peer.num_channels
            ) as session:
                client.session = session
                opened.set_result(None)
                LOG.info("a WebRTC client is streaming", extra={"session": session.name})
                async for num_lost, pcm, num_frames in peer.sound():
                    session.skip(num_lost)
                    session.send(pcm, num_frames)
                    for error in session.errors():
                        self._viewers.forward(session.name, Kind.TEXT, error_text(error))
                client.is_ending = True
        except Exception as error:
            if opened.done():
                raise
            opened.set_exception(error)
        finally:
            await self._drop(name)

    async def _drop(self, name: str) -> None:
        client = self._open.pop(name)
        client.place.close()
        for task in client.tasks:
            task.cancel()
        if client.peer is not None:
            await client.peer.close()

    def _on_channel(self, client: _Client, channel: RTCDataChannel) -> None:
        if client.session is None or client.tasks:
            channel.close()  # one is enough
            return
        commands: asyncio.Queue[str | bytes] = asyncio.Queue(MAX_COMMANDS)

        def keep(message: str | bytes) -> None:
            with contextlib.suppress(asyncio.QueueFull):
                commands.put_nowait(message)

        channel.on("message", keep)
        client.tasks |= {
            asyncio.create_task(self._show(client.session, client.shapes, channel)),
            asyncio.create_task(self._obey(client.session, channel, commands)),
        }

    async def _show(
        self, session: OwnSession, shapes: ShapeView | None, channel: RTCDataChannel
    ) -> None:
        """Send what a viewer of the session gets, but the sound."""
        with self._viewers.join(session.name, shapes) as outbox:
            while True:
                message = await outbox.get()
                if isinstance(message, bytes) and message[0] == wire.SOUND_TYPE:
                    continue
                if channel.readyState != "open":
                    return
                channel.send(message)
                while channel.bufferedAmount > MAX_BUFFERED_BYTES:
                    await asyncio.sleep(BUFFER_WAIT_S)

    async def _obey(
        self, session: OwnSession, channel: RTCDataChannel, commands: asyncio.Queue[str | bytes]
    ) -> None:
        """Do what the client asks for."""
        pace = Pace()
        while True:
            message = await commands.get()
            try:
                if isinstance(message, bytes):
                    raise UserError("expected a JSON object, as a text message")
                command = wire.parse_command(message)
                if command.flush:
                    await session.flush()
                if command.lips:
                    await session.choose_lips(command.lips)
            except UserError as error:
                if channel.readyState == "open":
                    channel.send(error_text(error))
            await pace.keep(COMMAND_S)
