"""WHIP (RFC 9725): a WebRTC client connects with one POST request.

The client's audio track streams into a separate session. Its data channel receives the messages
of a viewer of that session, except the sound, and accepts ``CHANNEL_COMMANDS``.
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
from kouxing_client import KouxingError, Refused

from kouxing.services.gateway.audio.audio_sessions import AudioClient, AudioSession, error_text
from kouxing.services.gateway.messages import browser_messages
from kouxing.services.gateway.messages.browser_messages import CHANNEL_COMMANDS
from kouxing.services.gateway.messages.shape_messages import ShapeEncoder, parse_shape_query
from kouxing.services.gateway.viewers.viewer_handler import ViewerHandler
from kouxing.services.gateway.viewers.viewer_queue import MessageKind
from kouxing.services.gateway.web.limits import COMMAND_S, ConnectionQuota, RealTimeLimit
from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG

if TYPE_CHECKING:
    from aiortc import RTCDataChannel

    from kouxing.services.gateway.webrtc.connection import WebRtcPeer

MAX_CLIENTS = 16
SDP = "application/sdp"
MAX_COMMANDS = 100  # limit of queued commands of one client
MAX_BUFFERED_BYTES = 16 * 1024  # limit for a data channel; more messages stay in the viewer's queue
BUFFER_CHECK_S = 0.02
COMMAND_DROPPED_TEXT = (
    f"the command is dropped: {MAX_COMMANDS} commands are queued; send at most"
    f" {1 / COMMAND_S:g} per second"
)
NO_WEBRTC_TEXT = (
    "this gateway has no WebRTC; install it where the gateway runs: pip install 'kouxing[webrtc]'\n"
)


@dataclass(slots=True, eq=False)
class _Client:
    peer: WebRtcPeer
    shape_encoder: ShapeEncoder | None  # encodes frames as blendshapes, in addition to FAPs
    session: AudioSession | None = None
    is_ending: bool = False  # the gateway itself closes the session
    tasks: set[asyncio.Task[None]] = field(default_factory=set)  # tasks of the data channel


class WhipHandler:
    """Serves ``/whip``.

    Clients may connect at ``addresses`` of this machine; empty: all except loopback.
    """

    def __init__(
        self,
        address_share: float,
        audio_client: AudioClient,
        viewers: ViewerHandler,
        addresses: Sequence[str],
    ) -> None:
        self._quota = ConnectionQuota(MAX_CLIENTS, "WebRTC clients", address_share)
        self._audio_client = audio_client
        self._viewers = viewers
        self._addresses = addresses
        self._clients: dict[str, _Client] = {}  # by the names of their resources
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_closing = False

    def __len__(self) -> int:
        return len(self._clients)

    async def serve_post(self, request: web.Request) -> web.StreamResponse:
        """Answer an SDP offer and open a session."""
        if request.content_type != SDP:
            raise web.HTTPUnsupportedMediaType(text=f"expected an SDP offer ({SDP})\n")
        if self._is_closing:
            raise web.HTTPServiceUnavailable(text="the gateway is stopping\n")
        name, shape_encoder = secrets.token_urlsafe(12), parse_shape_query(request.query)
        async with contextlib.AsyncExitStack() as stack:
            stack.enter_context(self._quota.hold(request))
            offer = (await request.read()).decode(errors="replace")
            peer = await self._make_peer(name)
            client = self._clients[name] = _Client(peer, shape_encoder)
            stack.push_async_callback(self._remove, name)
            try:
                answer = await peer.answer(offer)
                opening = self._audio_client.open(
                    encoding="s16le", sample_rate_hz=peer.rate_hz, num_channels=peer.num_channels
                )
                client.session = session = await stack.enter_async_context(opening)
            except UserError as error:
                raise web.HTTPUnprocessableEntity(text=f"{error}\n") from None
            except KouxingError as error:
                wait_s = error.retry_after_s if isinstance(error, Refused) else 0.0
                headers = {"Retry-After": str(math.ceil(wait_s))} if wait_s else {}
                raise web.HTTPServiceUnavailable(text=f"{error}\n", headers=headers) from None
            task = asyncio.create_task(self._stream(client, session, stack.pop_all()))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        headers = {"Location": f"{request.path}/{name}"}
        return web.Response(status=201, text=answer, content_type=SDP, headers=headers)

    async def serve_delete(self, request: web.Request) -> web.StreamResponse:
        """End a client's connection."""
        client = self._clients.get(request.match_info["name"])
        if client is None:
            raise web.HTTPNotFound
        await client.peer.close()
        return web.Response()

    async def close_session(self, session: str) -> None:
        """End the connection whose session was closed by control."""
        for client in [*self._clients.values()]:
            has_session = client.session is not None and client.session.name == session
            if has_session and not client.is_ending:
                await client.peer.close()

    async def close_all(self) -> None:
        """End every connection and reject new ones."""
        self._is_closing = True
        closing = [client.peer.close() for client in self._clients.values()]
        await asyncio.gather(*closing, return_exceptions=True)

    async def _make_peer(self, name: str) -> WebRtcPeer:
        module = "kouxing.services.gateway.webrtc.connection"
        try:
            webrtc = await asyncio.to_thread(importlib.import_module, module)
        except ModuleNotFoundError:
            raise web.HTTPNotImplemented(text=NO_WEBRTC_TEXT) from None
        if self._addresses:
            webrtc.use_addresses(self._addresses)
        peer: WebRtcPeer = webrtc.WebRtcPeer(lambda channel: self._on_channel(name, channel))
        return peer

    async def _stream(
        self, client: _Client, session: AudioSession, stack: contextlib.AsyncExitStack
    ) -> None:
        """Stream a client's sound into its session until it disconnects, then close the stack."""
        rate_limit = RealTimeLimit()
        async with stack:
            LOG.info("a WebRTC client is streaming", extra={"session": session.name})
            try:
                async for num_lost, pcm, num_samples in client.peer.receive_audio():
                    if num_lost:
                        session.skip(num_lost)
                    if not rate_limit.admit(num_samples / client.peer.rate_hz):
                        continue  # a client cannot be slowed down
                    session.send(pcm, num_samples)
                    for error in session.take_errors():
                        self._viewers.forward(session.name, MessageKind.TEXT, error_text(error))
            except KouxingError as error:  # the session has ended
                self._viewers.forward(session.name, MessageKind.TEXT, error_text(error))
            client.is_ending = True

    async def _remove(self, name: str) -> None:
        client = self._clients.pop(name)
        for task in client.tasks:
            task.cancel()
        await client.peer.close()

    def _on_channel(self, name: str, channel: RTCDataChannel) -> None:
        client = self._clients.get(name)
        if client is None or client.session is None or client.tasks:
            channel.close()  # a client has at most one
            return
        commands: asyncio.Queue[str | bytes] = asyncio.Queue(MAX_COMMANDS)

        def enqueue(message: str | bytes) -> None:
            try:
                commands.put_nowait(message)
            except asyncio.QueueFull:
                _send_error(channel, UserError(COMMAND_DROPPED_TEXT))

        channel.on("message", enqueue)
        client.tasks |= {
            asyncio.create_task(self._send_messages(client.session, client.shape_encoder, channel)),
            asyncio.create_task(self._handle_commands(client.session, channel, commands)),
        }

    async def _send_messages(
        self, session: AudioSession, shape_encoder: ShapeEncoder | None, channel: RTCDataChannel
    ) -> None:
        """Send the messages of a viewer of the session, except the sound."""
        with self._viewers.connect_viewer(session.name, shape_encoder) as viewer:
            while True:
                message = await viewer.queue.get()
                if isinstance(message, bytes) and message[0] == browser_messages.SOUND_TYPE:
                    continue
                if channel.readyState != "open":
                    return
                channel.send(message)
                while channel.readyState == "open" and channel.bufferedAmount > MAX_BUFFERED_BYTES:
                    await asyncio.sleep(BUFFER_CHECK_S)

    async def _handle_commands(
        self, session: AudioSession, channel: RTCDataChannel, commands: asyncio.Queue[str | bytes]
    ) -> None:
        rate_limit = RealTimeLimit()
        while True:
            message = await commands.get()
            try:
                if isinstance(message, bytes):
                    raise UserError("expected a JSON object in a text message")
                command = browser_messages.parse_command(message, known=CHANNEL_COMMANDS)
                if command.flush:
                    await session.flush()
                if command.face:
                    await session.set_face(**command.face)
                if command.problem:
                    raise UserError(command.problem)
            except (UserError, KouxingError) as error:
                _send_error(channel, error)
            await rate_limit.wait(COMMAND_S)


def _send_error(channel: RTCDataChannel, error: UserError | KouxingError) -> None:
    """Send an error, unless the client does not read its messages."""
    if channel.readyState == "open" and channel.bufferedAmount <= MAX_BUFFERED_BYTES:
        channel.send(error_text(error))
