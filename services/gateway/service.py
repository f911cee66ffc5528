"""The gateway service: shows sessions in browsers, and streams microphones into sessions.

It streams audio to recognizers like any other client.
"""

import asyncio
import ipaddress
import math
import time
from collections.abc import Coroutine

from aiohttp import web
from kouxing_client.messages import EndOfFaps, FapFrame, Message, Phone, Sound, Speech

from kouxing.services.gateway.audio.audio_sessions import AudioClient
from kouxing.services.gateway.audio.microphone_handler import MicrophoneHandler
from kouxing.services.gateway.audio.sample_sentence import SampleSentence
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.messages import browser_messages
from kouxing.services.gateway.senders_api import SendersApi
from kouxing.services.gateway.uploads.upload_handlers import AudioUploadHandler, LearnMouthHandler
from kouxing.services.gateway.viewers.viewer_handler import ViewerHandler
from kouxing.services.gateway.viewers.viewer_queue import MessageKind
from kouxing.services.gateway.web import web_application
from kouxing.services.gateway.web.page_endpoint import make_page_endpoint
from kouxing.services.gateway.web.web_server import WebServer, bind_port
from kouxing.services.gateway.webrtc.whip_handler import WhipHandler
from kouxing.services.service_kinds import KINDS
from kouxing.shared.clock import to_samples
from kouxing.shared.errors import UserError
from kouxing.shared.face.idle_motion import RESTING_RATE_HZ, RestingFace
from kouxing.shared.network.peer import Peer
from kouxing.shared.network.sockets import Socket
from kouxing.shared.phones import events
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, PhoneInventory, load_inventory
from kouxing.shared.phones.syllable_captions import SyllableCaptions
from kouxing.shared.service.message_loop import Handler
from kouxing.shared.service.session_follower import SessionFollower
from kouxing.shared.service.session_service import SessionService
from kouxing.shared.wire.control import HeartbeatReply, SessionProgress, StartSession
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.speech import Acoustic

MISSING_S = 3.0  # delay before a missing service is shown, because control may have restarted
CONTROL_MISSING_S = 8.0  # delay before a missing control is shown; a restart is faster


class _FollowedSession(SessionFollower):
    """A session to which the gateway subscribes, from its first use until it ends."""

    syllables: SyllableCaptions


class GatewayService(SessionService):
    """The gateway process.

    HTTP runs in an asyncio loop. The loop runs while the service waits for messages.
    """

    kind = KINDS["gateway"]

    def __init__(self, config: GatewayConfig) -> None:
        listener = bind_port(config.host, config.port)
        self._runner = asyncio.Runner()
        self._loop = self._runner.get_loop()
        self._is_waiting = False
        super().__init__(config)
        host, port = listener.getsockname()[:2]
        endpoint = make_page_endpoint(config, port)
        self.endpoints = {"page": endpoint.url}
        self._sessions: dict[str, _FollowedSession] = {}
        self._web_sockets = web_application.OpenWebSockets()
        share = config.address_share
        self._audio_client = AudioClient(self.control_endpoint, self.key, self.warn)
        self._sample = SampleSentence(self._audio_client)
        self._viewers = ViewerHandler(
            self._web_sockets, share, self.metrics, self._sample, self._set_face, self.waker.wake
        )
        self._microphones = MicrophoneHandler(self._web_sockets, share, self._audio_client)
        self._whip_handler = WhipHandler(
            share,
            self._audio_client,
            self._viewers,
            [] if ipaddress.ip_address(host).is_unspecified else [host],
        )
        self._learn_mouth_handler = LearnMouthHandler()
        self._audio_upload = AudioUploadHandler()
        self._senders = SendersApi(config.senders, self.waker.wake, idle_motion=config.idle_motion)
        self._routes = (
            web.get("/viewer", self._viewers.serve),
            web.get("/microphone", self._microphones.serve),
            web.post("/whip", self._whip_handler.serve_post),
            web.delete("/whip/{name}", self._whip_handler.serve_delete),
            web.post("/learn-mouth", self._learn_mouth_handler.serve),
            web.post("/sound", self._audio_upload.serve),
            web.get("/senders", self._senders.serve_get),
            web.post("/senders", self._senders.serve_post),
        )
        self._application = web_application.make_application(
            head=config.head,
            access=endpoint.access,
            frame_ancestors=" ".join(config.trusted_origins),
            routes=self._routes,
        )
        self._server = WebServer(listener, endpoint.tls, share)
        self._tasks: set[asyncio.Task[None]] = set()
        self._closing: asyncio.Task[None] | None = None
        self._resting_face = RestingFace(idle_motion=config.idle_motion)
        self._resting_frame_due_s = 0.0
        self._replied_s = -math.inf  # time of control's newest reply
        self._missing_since_s = math.inf  # time of the first reply that lacks a service

    # --- the loop --------------------------------------------------------------------------------

    def on_startup(self) -> None:
        """Start serving HTTP."""
        unlimited = {route.path for route in self._routes}
        self._loop.run_until_complete(self._server.start(self._application, unlimited))
        self._loop.add_reader(self.waker.descriptor, self._on_input)

    def wait(self, timeout_s: float) -> list[Socket]:
        """Run the HTTP loop until messages arrive or the time has passed."""
        # The descriptors are edge-triggered: they do not signal messages beyond a full batch.
        timer = self._loop.call_later(0.0 if super().wait(0) else timeout_s, self._loop.stop)
        self._is_waiting = True
        self._loop.run_forever()
        self._is_waiting = False
        timer.cancel()
        return super().wait(0)

    def register(
        self, socket: Socket, handlers: dict[type[Message], Handler], *, is_quiet: bool = False
    ) -> None:
        """Register handlers for a socket's messages, by message type."""
        super().register(socket, handlers, is_quiet=is_quiet)
        self._loop.add_reader(socket.file_descriptor, self._on_input)

    def unregister(self, socket: Socket) -> None:
        """Stop handling a socket's messages and close it."""
        self._loop.remove_reader(socket.file_descriptor)
        super().unregister(socket)

    def on_drain(self) -> bool:
        """Close all browser connections. The last frames of their microphones still arrive."""
        if self._closing is None:
            self._closing = self._create_task(self._web_sockets.close_all())
            self._create_task(self._whip_handler.close_all())
            self._learn_mouth_handler.close()
            self._audio_upload.close()
            self._sample.stop()
        is_uploading = self._learn_mouth_handler.is_running or self._audio_upload.is_running
        is_connected = self._web_sockets or self._whip_handler or self._sample.open_sessions
        return self._closing.done() and not is_uploading and not is_connected

    def on_shutdown(self) -> None:
        """Stop HTTP, then what its requests use."""
        self._loop.run_until_complete(self._server.stop())
        self._loop.run_until_complete(self._audio_client.close())
        self._senders.pool.close()
        self._runner.close()

    def send_to_control(self, message: Message) -> None:
        """Send to control, then read its messages, because sending may reset the descriptor."""
        super().send_to_control(message)
        self._on_input()

    def _on_input(self) -> None:
        if self._is_waiting:
            self._loop.stop()

    def _create_task(self, coroutine: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task = self._loop.create_task(coroutine)
        self._tasks.add(task)  # the loop keeps only a weak reference
        task.add_done_callback(self._tasks.discard)
        return task

    # --- from control ----------------------------------------------------------------------------

    def start_session(self, start: StartSession) -> bool:
        """Subscribe to a session for a viewer or sender; confirm when this is in effect."""
        session = self._sessions.get(start.session)
        if session is not None and session.session_start.token != start.token:
            self.stop_session(start.session)  # a different session with the same name
            session = None
        if session is None:
            session = self._sessions[start.session] = self._make_session(start)
        session.session_start = start
        self._announce(session, start.epoch)
        is_needed = start.session in self._needed_sessions() or self._audio_client.num_opening
        if session.is_following or is_needed:
            session.follow()
        return not session.is_following

    def _needed_sessions(self) -> set[str]:
        """Return the sessions that are shown or sent to other programs."""
        needed = {*self._viewers.shown_sessions}
        if self._senders.pool.is_sending:
            needed.add(self._viewers.newest_session)
        return needed

    def stop_session(self, session: str) -> None:
        """Unsubscribe from a session and notify its viewers and its microphone."""
        stopped = self._sessions.pop(session, None)
        if stopped is not None:
            stopped.close()
        self._viewers.remove_session(session)
        self._audio_client.on_closed(session)
        self._create_task(self._microphones.close_session(session))
        self._create_task(self._whip_handler.close_session(session))

    def change_face(self, message: SetFace) -> None:
        """Change the face at rest, or notify viewers of a change of a session's face."""
        if message.session == "" and (strengths := message.face.expressions) is not None:
            self._resting_face.express(strengths, message.face.hold_s)
            self._senders.pool.express(strengths, message.face.hold_s)
        session = self._sessions.get(message.session)
        if session is not None:
            start = session.session_start
            face = start.opening.face.merged_with(message.face)
            session.session_start = start.with_face(face)
            self._viewers.change_face(message.session, message.face)

    def session_progress(self) -> dict[str, SessionProgress]:
        """Return the subscribed sessions, so that control can report ended ones."""
        return dict.fromkeys(self._sessions, SessionProgress())

    def on_tick(self, now_s: float) -> float:
        """Follow sessions, move the face at rest, and announce a missing control."""
        sessions = [*self._sessions.values()]
        if not all(session.is_following for session in sessions):
            needed = self._needed_sessions()
            for session in sessions:
                if session.session in needed and not session.is_following:
                    session.follow()
        resting_frame_due_s = max(self._resting_frame_due_s, self._viewers.resting_frame_due_s)
        if now_s >= resting_frame_due_s:
            self._resting_frame_due_s = resting_frame_due_s = max(
                self._resting_frame_due_s + 1.0 / RESTING_RATE_HZ, now_s
            )
            self._viewers.show_resting_face(self._resting_face, now_s)
        missing_due_s = self._replied_s + CONTROL_MISSING_S
        if now_s > missing_due_s:
            self._viewers.announce_missing_services(("control",))
            missing_due_s = math.inf
        return min(missing_due_s, resting_frame_due_s)

    def on_heartbeat_reply(self, reply: HeartbeatReply, sender: Peer) -> None:
        """Announce missing services to the viewers."""
        super().on_heartbeat_reply(reply, sender)
        self._audio_client.idle_limit_s = reply.idle_limit_s
        self._replied_s = time.monotonic()
        since_s = min(self._missing_since_s, self._replied_s) if reply.missing else math.inf
        self._missing_since_s = since_s
        if not reply.missing or self._replied_s > since_s + MISSING_S:
            self._viewers.announce_missing_services(tuple(reply.missing))

    def _set_face(self, session: str, face: FaceSettings) -> None:
        self.send_to_control(SetFace(session=session, face=face))

    # --- from the publishers ---------------------------------------------------------------------

    def _make_session(self, start: StartSession) -> _FollowedSession:
        session = _FollowedSession(
            self,
            start,
            {
                EndOfFaps: self._on_end,
                FapFrame: self._on_frame,
                Phone: self._on_phone,
                Sound: self._on_sound,
                Speech: self._on_speech,
                Acoustic: self._on_acoustic,
            },
            on_new_epoch=lambda: self._restart(session),
        )
        characters = self._sample.characters if start.session in self._sample.open_sessions else ()
        session.syllables = SyllableCaptions(self._inventory(start), characters)
        return session

    def _inventory(self, start: StartSession) -> PhoneInventory:
        try:
            return load_inventory(start.facts.language or DEFAULT_LANGUAGE)
        except UserError as error:  # only the captions depend on the inventory
            self.warn("language", str(error), start.session)
            return load_inventory()

    def _restart(self, session: _FollowedSession) -> None:
        """Restart a session for its viewers. It continues in a new epoch."""
        session.syllables.reset()
        self._announce(session, session.epoch)

    def _announce(self, session: _FollowedSession, epoch: int) -> None:
        """Announce a session to its viewers, or its new epoch."""
        start = session.session_start
        facts, language = start.facts, session.syllables.inventory.code
        default = FaceSettings(expressiveness=facts.expressiveness, feeling=facts.feeling)
        face = default.merged_with(start.opening.face)
        self._viewers.add_session(start.session, epoch, face, language)

    def _on_frame(self, frame: FapFrame) -> None:
        now_s, values = time.monotonic(), frame.packed_values
        self._viewers.show_frame(frame.session, frame.epoch, frame.media_time, values, now_s)
        if self._senders.pool.is_sending and frame.session == self._viewers.newest_session:
            self._senders.send_frame(frame.media_time, values)

    def _on_sound(self, sound: Sound) -> None:
        message = browser_messages.encode_binary(
            browser_messages.SOUND_TYPE, sound.epoch, sound.media_time, sound.pcm
        )
        self._viewers.forward(sound.session, MessageKind.SOUND, message)

    def _on_phone(self, phone: Phone) -> None:
        syllables = self._sessions[phone.session].syllables
        message = browser_messages.encode_json(
            "phone",
            index=phone.index,
            symbol=phone.symbol,
            text=syllables.inventory.write(phone.symbol),
            media_time=phone.media_time,
            duration=phone.duration,
            confidence=phone.confidence,
            final=phone.final,
        )
        self._viewers.forward(phone.session, MessageKind.TEXT, message)
        for syllable in syllables.update(events.Phone.from_message(phone)):
            message = browser_messages.encode_json(
                "syllable",
                index=syllable.index,
                symbol=syllable.text,
                media_time=to_samples(syllable.onset_s),
                duration=to_samples(syllable.duration_s),
                final=syllable.final,
            )
            self._viewers.forward(phone.session, MessageKind.TEXT, message)

    def _on_speech(self, speech: Speech) -> None:
        message = browser_messages.encode_json(
            "speech", active=speech.active, media_time=speech.media_time
        )
        self._viewers.forward(speech.session, MessageKind.SPEECH, message)

    def _on_acoustic(self, acoustic: Acoustic) -> None:
        self._viewers.announce_acoustic_model(acoustic.session, acoustic.model)

    def _on_end(self, end: EndOfFaps) -> None:
        self._audio_client.on_last_frame(end.session)
        message = browser_messages.encode_json("end", media_time=end.media_time)
        self._viewers.forward(end.session, MessageKind.END, message)
