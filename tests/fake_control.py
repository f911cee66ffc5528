"""Control, a recognizer and a synthesizer that a test scripts, on a separate thread."""

import itertools
import queue
import threading
from collections.abc import Callable
from typing import Any, Self, TypeVar

from kouxing_client.keys import Key
from kouxing_client.messages import Message, ServiceState, SessionFacts

from kouxing.shared.fast_record import replace
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.peer import NO_PEER, Peer
from kouxing.shared.network.sockets import Poller, Socket
from kouxing.shared.wire.control import Heartbeat, HeartbeatReply, SessionStarted, StartSession
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.session import (
    AudioChunk,
    CloseSession,
    Done,
    Error,
    FlushSession,
    OpenSession,
    SessionOpened,
    StatusReport,
    StatusRequest,
)
from kouxing.shared.wire.speech import Acknowledge
from tests.samples import START, with_opening
from tests.system import LIMIT_S, wait_until

LOCAL = "tcp://127.0.0.1:*"
TOKEN = "token"  # noqa: S105 - not a secret, but what the protocol calls it
FACTS = SessionFacts(language="mandarin", frame_rate_hz=50.0, expressiveness=1.0)
EPOCH = 1
MessageType = TypeVar("MessageType", bound=Message)


class FakeControl:
    """Opens and closes sessions, acknowledges audio, and records what it receives.

    A service that sends heartbeats is the ``service`` of all sessions. A session opens when the
    service has started it; without a service, it opens at once.

    Attributes
    ----------
    name
        Instance of control, for heartbeats.
    audio_endpoint
        Where clients send audio; a test may name an address without a recognizer.
    running
        Services in the status.
    refuse
        Whether no session is opened, and no face is changed.
    stops
        Sessions to stop, before each answer to a heartbeat.
    heartbeats
        Heartbeats of the service.
    received
        Other messages to control.
    openings
        Requests for sessions, by session.
    audio_messages
        Messages to the recognizer.
    """

    def __init__(self, key: Key | None = None) -> None:
        self.bus = Bus(key)
        self.commands = self.bus.bind_router(LOCAL, "commands")
        self.audio = self.bus.bind_router(LOCAL, "audio")
        self.phones = self.bus.bind_publisher(LOCAL, "phones")
        self.faps = self.bus.bind_publisher(LOCAL, "faps")
        self.events = self.bus.bind_publisher(LOCAL, "events")
        self.address = self.commands.endpoint
        self.audio_endpoint = self.audio.endpoint
        self.name = "control-1"
        self.running = ["recognizer", "synthesizer"]
        self.refuse = False
        self.is_silent = False  # whether it answers nothing
        self.stops: list[str] = []
        self.service = NO_PEER
        self.heartbeats: list[Heartbeat] = []
        self.received: list[Message] = []
        self.audio_messages: list[AudioChunk] = []
        self.audio_sender = NO_PEER
        self.openings: dict[str, OpenSession] = {}
        self._clients: dict[str, Peer] = {}
        self._numbers = itertools.count()
        self._poller = Poller()
        self._jobs: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._stop = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop = True
        self._thread.join()
        self.bus.close()

    def clear(self) -> None:
        """Forget what earlier tests did."""
        self.running, self.refuse = ["recognizer", "synthesizer"], False
        self.received.clear()
        self.openings.clear()
        self.audio_messages.clear()

    def run_job(self, job: Callable[[], object]) -> None:
        """Run a job on the thread that owns the sockets, and wait until it is done."""
        done = threading.Event()
        self._jobs.put(job)
        self._jobs.put(done.set)
        assert done.wait(LIMIT_S)

    def publish(self, publisher: Socket, *messages: Message) -> None:
        self.run_job(lambda: [publisher.send(message) for message in messages])

    def send(self, message: Message) -> None:
        """Send a message to the service."""
        self.run_job(lambda: self.commands.send(message, to=self.service))

    def start(self, session: str, **fields: Any) -> None:
        """Start a session at the service, and wait until it has started."""
        num_started = len(self.messages_of(SessionStarted))
        self.send_start(session, **fields)
        wait_until(lambda: len(self.messages_of(SessionStarted)) > num_started)

    def send_start(self, session: str, **fields: Any) -> None:
        self.send(self._start_message(session, **fields))

    def stop_session(self, session: str) -> None:
        self.send(CloseSession(session=session))

    def bind_audio(self) -> None:
        """Start a recognizer at the address that clients are given."""
        self.audio = self.bus.bind_router(self.audio_endpoint, "audio")
        self._poller.add(self.audio)

    def messages_of(self, kind: type[MessageType]) -> list[MessageType]:
        """Return the received messages of a kind."""
        return [message for message in [*self.received] if isinstance(message, kind)]

    def sessions_of(self, kind: type[Message]) -> list[str]:
        """Return the sessions of the received messages of a kind."""
        return [message.session for message in self.messages_of(kind)]

    @property
    def page(self) -> str:
        """Address of the gateway's page; waits for the gateway."""
        wait_until(lambda: self.heartbeats)
        return self.heartbeats[-1].endpoints["page"]

    def on_message(self, message: Message, sender: Peer) -> None:
        """Handle a message to control."""
        if self.is_silent:
            return
        match message:
            case Heartbeat():
                self._on_heartbeat(message, sender)
            case OpenSession() | SetFace() if self.refuse:
                refusal = Error(code="no-service", text="start one", request=message.request)
                self.commands.send(refusal, to=sender)
                return
            case OpenSession():
                self._on_open(message, sender)
            case SessionStarted() if message.session in self.openings:
                self._answer_open(message.session)
            case StatusRequest():
                self.commands.send(self._status(message), to=sender)
            case CloseSession() if self.service != NO_PEER:
                self.commands.send(CloseSession(session=message.session), to=self.service)
            case SetFace() if self.service != NO_PEER:
                self.commands.send(message, to=self.service)
        if isinstance(message, CloseSession | FlushSession | SetFace) and message.request:
            done = Done(session=message.session, request=message.request)
            self.commands.send(done, to=sender)

    def on_audio(self, chunk: AudioChunk, sender: Peer) -> None:
        """Handle a message to the recognizer."""
        self.audio_messages.append(chunk)
        self.audio_sender = sender
        acknowledgement = Acknowledge(session=chunk.session, sequence=chunk.sequence)
        self.audio.send(acknowledgement, to=sender)

    def on_tick(self) -> None:
        """Work between messages."""

    def _on_heartbeat(self, beat: Heartbeat, sender: Peer) -> None:
        self.service = sender
        for session in self.stops:
            self.commands.send(CloseSession(session=session), to=sender)
        reply = HeartbeatReply(
            sent_ns=beat.sent_ns,
            received_ns=beat.sent_ns,
            replied_ns=beat.sent_ns,
            control_instance=self.name,
            missing=[kind for kind in ("recognizer", "synthesizer") if kind not in self.running],
        )
        self.commands.send(reply, to=sender)
        self.heartbeats.append(beat)

    def _on_open(self, opening: OpenSession, client: Peer) -> None:
        session = opening.session or f"s{next(self._numbers)}"
        self.openings[session], self._clients[session] = opening, client
        if self.service == NO_PEER:
            self._answer_open(session)
        else:
            self.commands.send(self._start_message(session), to=self.service)

    def _answer_open(self, session: str) -> None:
        opened = SessionOpened(
            session=session,
            epoch=EPOCH,
            request=self.openings[session].request,
            token=TOKEN,
            audio=self.audio_endpoint,
            phones=self.phones.endpoint,
            faps=self.faps.endpoint,
            events=self.events.endpoint,
            facts=FACTS,
        )
        self.commands.send(opened, to=self._clients[session])

    def _start_message(
        self, session: str, *, epoch: int = EPOCH, record: bool = False, token: str = TOKEN
    ) -> StartSession:
        face = FaceSettings(lip_model="dynamic-visemes")
        return replace(
            with_opening(START, record=record, face=face),
            session=session,
            epoch=epoch,
            request=f"start-{session}-{epoch}",
            token=token,
            facts=FACTS,
            endpoints={"phones": self.phones.endpoint, "faps": self.faps.endpoint},
        )

    def _run(self) -> None:
        for socket in (self.commands, self.audio, self.phones, self.faps, self.events):
            self._poller.add(socket)
        while not self._stop:
            while not self._jobs.empty():
                self._jobs.get()()
            self.on_tick()
            for socket in self._poller.wait(0.005):
                for received in socket.receive():
                    message = received.message
                    if socket is self.commands and isinstance(message, Message):
                        if not isinstance(message, Heartbeat):
                            self.received.append(message)
                        self.on_message(message, received.sender)
                    elif isinstance(message, AudioChunk):
                        self.on_audio(message, received.sender)

    def _status(self, request: StatusRequest) -> StatusReport:
        states = [
            ServiceState(
                service=name,
                role="worker",
                instance=name,
                state="ready",
                age_s=0,
                clock_offset_ms=0,
                endpoints={},
                metrics={},
            )
            for name in self.running
        ]
        return StatusReport(request=request.request, services=states, sessions=[])
