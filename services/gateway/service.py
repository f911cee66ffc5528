"""The gateway as a service: sessions to browsers, a browser's microphone to a session.

Reacts to: start-session, stop-session, use-lips, status-report (control), fap-frame, end-of-faps
(synthesizer), sound, phone, speech (recognizer), and to what browsers send. Emits: status-request,
express, choose-expressiveness (control), WebSocket messages (browsers), and, as an ordinary client,
audio-chunk (recognizer).
"""

from __future__ import annotations

import asyncio
import ipaddress
import math
import secrets
import socket
import ssl
import time
from collections.abc import Coroutine
from dataclasses import dataclass, replace

from aiohttp import web

from kouxing.services.gateway import http, wire
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.entrance import make_entrance
from kouxing.services.gateway.learn_mouth import MouthLearner
from kouxing.services.gateway.listener import Listener, bind
from kouxing.services.gateway.microphone import SAMPLE_TEXT, Microphones, Sample
from kouxing.services.gateway.outbox import Kind
from kouxing.services.gateway.own_sessions import OwnSessions, error_text
from kouxing.services.gateway.sending import Sending
from kouxing.services.gateway.viewers import Viewers
from kouxing.services.gateway.vosk import VoskClients
from kouxing.services.gateway.whip import WhipClients
from kouxing.shared.bus import Socket
from kouxing.shared.clock import to_samples
from kouxing.shared.errors import UserError
from kouxing.shared.face.idle_motion import REST_RATE_HZ, RestingFace
from kouxing.shared.follower import SessionFollower
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, PhoneInventory, load_inventory
from kouxing.shared.phones.known_text import Characters, characters_of
from kouxing.shared.phones.syllables import SyllableTrack
from kouxing.shared.service import Handler, Service
from kouxing.shared.wire.audio import Sound
from kouxing.shared.wire.control import SessionInput, StartSession, StatusReport, StatusRequest
from kouxing.shared.wire.events import phone_of
from kouxing.shared.wire.face import EndOfFaps, FapFrame
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import ChooseExpressiveness, Express
from kouxing.shared.wire.speech import Phone, Speech

STATUS_S = 1.0
STATUS_LOST_S = 3.0  # after which it is asked again
MISSING_S = 3.0  # after which a service that control does not know is told: control may be new
CONTROL_MISSING_S = 8.0  # the same of control, which may start again unnoticed


@dataclass(slots=True)
class _Session:
    """One session that the gateway follows."""

    start: StartSession
    follower: SessionFollower
    syllables: SyllableTrack
    silence: str  # the phone of a pause


class GatewayService(Service):
    """The gateway process.

    HTTP runs in an asyncio loop, which gets its turn whenever the service waits for messages.
    """

    name = "gateway"
    role = "observer"
    needs = ("phones", "faps")
    client_roles = ("client",)

    def __init__(self, config: GatewayConfig) -> None:
        listening = bind(config.host, config.port)
        vosk_listening = (
            bind(config.host, config.vosk_port, "gateway.vosk_port") if config.vosk_port else None
        )
        self._runner = asyncio.Runner()
        self._loop = self._runner.get_loop()
        self._is_waiting = False
        super().__init__(config)
        entrance = make_entrance(config, listening.getsockname()[1])
        self.endpoints = {"page": entrance.url}
        self._sessions: dict[str, _Session] = {}
        self._web_sockets = http.WebSockets()
        share = self._share = config.address_share
        self._viewers = Viewers(
            self._web_sockets,
            share,
            self.metrics,
            self._play_sample,
            self._choose_sample_lips,
            self._express,
            self._choose_expressiveness,
        )
        self._own_sessions = OwnSessions(self.control_endpoint, self.key, self.warn)
        self._microphones = Microphones(self._web_sockets, share, self._own_sessions)
        self._vosk_clients = VoskClients(self._web_sockets, share, self._own_sessions)
        bound = listening.getsockname()[0]
        self._whip_clients = WhipClients(
            share,
            self._own_sessions,
            self._viewers,
            [] if ipaddress.ip_address(bound).is_unspecified else [bound],
        )
        self._mouth_learner = MouthLearner()
        self._sending = Sending(config.senders, config.idle_motion_seed)
        routes = (
            web.get("/viewer", self._viewers.serve),
            web.get("/microphone", self._microphones.serve),
            web.get("/vosk", self._vosk_clients.serve),
            web.post("/whip", self._whip_clients.serve_offer),
            web.delete("/whip/{name}", self._whip_clients.serve_end),
            web.post("/learn-mouth", self._mouth_learner.serve),
            web.get("/senders", self._sending.show),
            web.post("/senders", self._sending.change),
        )
        application = http.make_application(
            page_asset=config.head,
            access=entrance.access,
            frame_ancestors=config.frame_ancestors,
            routes=routes,
        )
        paths = {route.path for route in routes}
        self._listeners = [(self._make_listener(listening, entrance.tls), application, paths)]
        if vosk_listening is not None:
            application = http.make_socket_application(self._vosk_clients.serve, entrance.access)
            self._listeners.append(
                (self._make_listener(vosk_listening, entrance.tls), application, {"/"})
            )
        self._tasks: set[asyncio.Task[None]] = set()
        self._sample: tuple[Sample, asyncio.Task[None]] | None = None  # while it is spoken
        self._sample_characters: Characters = ()  # once they are needed
        self._closing: asyncio.Task[None] | None = None
        self._resting_face = RestingFace(config.idle_motion_seed)
        self._rest_due_s = 0.0
        self._report_s = -math.inf
        self._incomplete_s = math.inf  # since when reports do not name all services
        self._request_s = 0.0

    # --- the loop --------------------------------------------------------------------------------

    def on_start(self) -> None:
        """Serve HTTP."""
        for listener, application, unlimited in self._listeners:
            self._loop.run_until_complete(listener.start(application, unlimited))

    def wait(self, timeout_s: float) -> list[Socket]:
        """Run HTTP until messages arrive or the time is over."""
        # The descriptors are edge-triggered: what a full batch left behind waits for the tick.
        timer = self._loop.call_later(timeout_s, self._loop.stop)
        self._is_waiting = True
        self._loop.run_forever()
        self._is_waiting = False
        timer.cancel()
        return super().wait(0)

    def register(self, socket: Socket, handlers: dict[type[Message], Handler]) -> None:
        """Handle messages that arrive on a socket, by their type."""
        super().register(socket, handlers)
        self._loop.add_reader(socket.file_descriptor, self._on_input)

    def unregister(self, socket: Socket) -> None:
        """Stop handling and close a socket."""
        self._loop.remove_reader(socket.file_descriptor)
        super().unregister(socket)

    def on_drain(self) -> bool:
        """Close every browser's connection; the last frames of their microphones still come."""
        if self._closing is None:
            self._closing = self._begin(self._web_sockets.close_all())
            self._begin(self._whip_clients.close_all())
            self._mouth_learner.close()
            if self._sample is not None:
                self._sample[1].cancel()
        is_busy = self._mouth_learner.is_learning or self._sample is not None
        is_connected = self._web_sockets or self._whip_clients
        return self._closing.done() and not is_busy and not is_connected

    def on_stopped(self) -> None:
        """End HTTP, and what is sent to other programs."""
        self._sending.close()
        for listener, *_ in self._listeners:
            self._loop.run_until_complete(listener.stop())
        self._runner.close()

    def _make_listener(self, listening: socket.socket, tls: ssl.SSLContext | None) -> Listener:
        return Listener(
            listening,
            tls,
            on_refused=lambda address: self.warn(
                "connections", f"refused a connection of {address}: there are too many"
            ),
            on_bad_request=lambda: self.warn("bad-http", "dropped a request: it is no HTTP"),
            share=self._share,
        )

    def _on_input(self) -> None:
        if self._is_waiting:
            self._loop.stop()

    def _begin(self, work: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task = self._loop.create_task(work)
        self._tasks.add(task)  # the loop itself keeps no reference
        task.add_done_callback(self._tasks.discard)
        return task

    # --- from control ----------------------------------------------------------------------------

    def start_session(self, start: StartSession) -> bool:
        """Follow a session; confirm once the subscriptions are in effect."""
        session = self._sessions.get(start.session)
        if session is None:
            session = self._sessions[start.session] = self._make_session(start)
        session.start = start
        session.follower.start(start.epoch, start.endpoints)
        self._viewers.add_session(start.session, start.epoch, start.lips)
        return False

    def stop_session(self, session: str) -> None:
        """Follow a session no longer; a microphone that feeds it is told."""
        stopped = self._sessions.pop(session, None)
        if stopped is not None:
            stopped.follower.close()
        self._viewers.remove_session(session)
        self._own_sessions.on_closed(session)
        self._begin(self._microphones.close_session(session))
        self._begin(self._vosk_clients.close_session(session))
        self._begin(self._whip_clients.close_session(session))

    def use_lips(self, session: str, lips: str) -> None:
        """Tell the viewers of a session that another lip model moves the mouth."""
        found = self._sessions.get(session)
        if found is not None:
            found.start = replace(found.start, lips=lips)
            self._viewers.set_lips(session, lips)

    def session_inputs(self) -> dict[str, SessionInput]:
        """Name the sessions followed, so that control can say which of them are no more."""
        return dict.fromkeys(self._sessions, SessionInput())

    def on_tick(self, now_s: float) -> None:
        """Ask control which services run, and let the face at rest live."""
        if self._viewers.is_anybody_there and now_s >= self._rest_due_s:
            self._rest_due_s = max(self._rest_due_s + 1.0 / REST_RATE_HZ, now_s)
            self._viewers.show_rest(self._resting_face.at(now_s).astype("<f4").tobytes())
        answered = self._report_s >= self._request_s
        if now_s - self._request_s > (STATUS_S if answered else STATUS_LOST_S):
            self._request_s = now_s
            self.tell_control(StatusRequest(request=secrets.token_hex(8)))
        if now_s - self._report_s > CONTROL_MISSING_S:
            self._viewers.set_missing(("control",))

    def on_status(self, report: StatusReport) -> None:
        """Take note which services run."""
        self._report_s = time.monotonic()
        running = {state.service for state in report.services if state.state == "ready"}
        needed = ("recognizer", "synthesizer")
        missing = tuple(service for service in needed if service not in running)
        self._incomplete_s = min(self._incomplete_s, self._report_s) if missing else math.inf
        if not missing or self._report_s > self._incomplete_s + MISSING_S:
            self._viewers.set_missing(missing)

    def _express(self, session: str, expressions: wire.Expressions) -> None:
        self.tell_control(
            Express(
                session=session,
                request=secrets.token_hex(8),
                expressions=expressions.strengths,
                hold_s=expressions.hold_s,
            )
        )

    def _choose_expressiveness(self, session: str, amount: float) -> None:
        request = secrets.token_hex(8)
        self.tell_control(
            ChooseExpressiveness(session=session, request=request, expressiveness=amount)
        )

    # --- from the publishers ---------------------------------------------------------------------

    def _make_session(self, start: StartSession) -> _Session:
        follower = SessionFollower(
            self,
            start.session,
            {
                EndOfFaps: self._on_end,
                FapFrame: self._on_frame,
                Phone: self._on_phone,
                Sound: self._on_sound,
                Speech: self._on_speech,
            },
            live=start.paced,
            on_complete=lambda: self.session_started(session.start),
            on_restart=lambda: self._restart(session),
        )
        is_sample = self._sample is not None and self._sample[0].session == start.session
        characters = self._sample_characters if is_sample else ()
        inventory = self._inventory(start)
        track = SyllableTrack(inventory, characters)
        session = _Session(start, follower, track, inventory.silence)
        return session

    def _inventory(self, start: StartSession) -> PhoneInventory:
        try:
            return load_inventory(start.language or DEFAULT_LANGUAGE)
        except UserError as error:  # it is only about captions
            self.warn("language", str(error), start.session)
            return load_inventory()

    def _restart(self, session: _Session) -> None:
        """Begin a session anew for its viewers: it goes on in another epoch."""
        session.syllables.reset()
        self._vosk_clients.on_restart(session.start.session)
        self._viewers.add_session(session.start.session, session.follower.epoch, session.start.lips)

    def _on_frame(self, frame: FapFrame) -> None:
        self._viewers.show_frame(frame.session, frame.epoch, frame.media_time, frame.values)
        if frame.session == self._viewers.newest:
            self._sending.accept(frame.media_time, frame.values)

    def _on_sound(self, sound: Sound) -> None:
        message = wire.binary(wire.SOUND_TYPE, sound.epoch, sound.media_time, sound.pcm)
        self._viewers.forward(sound.session, Kind.SOUND, message)

    def _on_phone(self, phone: Phone) -> None:
        message = wire.text(
            "phone",
            index=phone.index,
            symbol=phone.symbol,
            media_time=phone.media_time,
            duration=phone.duration,
            confidence=phone.confidence,
            final=phone.final,
        )
        self._viewers.forward(phone.session, Kind.TEXT, message)
        session, recognised = self._sessions[phone.session], phone_of(phone)
        is_silence = phone.symbol == session.silence
        self._vosk_clients.on_phone(phone.session, recognised, is_silence=is_silence)
        for syllable in session.syllables.accept(recognised):
            message = wire.text(
                "syllable",
                index=syllable.index,
                symbol=syllable.text,
                media_time=to_samples(syllable.onset_s),
                duration=to_samples(syllable.duration_s),
                final=syllable.final,
            )
            self._viewers.forward(phone.session, Kind.TEXT, message)

    def _on_speech(self, speech: Speech) -> None:
        self._vosk_clients.on_speech(speech.session, active=speech.active)
        message = wire.text("speech", active=speech.active, media_time=speech.media_time)
        self._viewers.forward(speech.session, Kind.TEXT, message)

    def _on_end(self, end: EndOfFaps) -> None:
        self._own_sessions.on_last_frame(end.session)
        message = wire.text("end", media_time=end.media_time)
        self._viewers.forward(end.session, Kind.TEXT, message)

    # --- the sample sentence ---------------------------------------------------------------------

    def _play_sample(self, lips: str) -> str:
        """Speak the sample sentence, unless it is being spoken; return its session."""
        if self._sample is None:
            sample = Sample(self._own_sessions, lips)
            self._sample = sample, self._begin(self._speak(sample))
        return self._sample[0].session

    def _choose_sample_lips(self, lips: str) -> None:
        if self._sample is not None:
            self._sample[0].lips = lips

    async def _speak(self, sample: Sample) -> None:
        error = ""
        try:
            if not self._sample_characters:  # takes 0.3 s
                self._sample_characters = await asyncio.to_thread(
                    characters_of, SAMPLE_TEXT, load_inventory()
                )
            await sample.speak()
        except UserError as refusal:
            error = error_text(refusal)
        finally:
            self._sample = None
            self._viewers.end_sample(error)
