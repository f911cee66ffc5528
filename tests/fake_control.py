"""Control, a recognizer and a synthesizer that a test scripts, on a thread of their own."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Self

from kouxing.shared.bus import Bus
from kouxing.shared.keys import Peer
from kouxing.shared.sockets import Poller, Socket
from kouxing.shared.wire.audio import AudioChunk
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    FlushSession,
    OpenSession,
    ServiceState,
    SessionFacts,
    SessionOpened,
    StatusReport,
    StatusRequest,
)
from kouxing.shared.wire.speech import Acknowledge

LOCAL = "tcp://127.0.0.1:*"
TOKEN = "token"  # noqa: S105 - not a secret, but what the protocol calls it


class FakeControl:
    """Opens and closes sessions, acknowledges audio, and records what it receives.

    Attributes
    ----------
    audio_endpoint
        Where clients send audio; a test may name an address without a recognizer.
    running
        Services in the status.
    refuse
        Whether no session is opened.
    received
        Messages to control other than heartbeats.
    audio_messages
        Messages to the recognizer.
    """

    def __init__(self) -> None:
        self.bus = Bus()
        self.commands = self.bus.bind_router(LOCAL, "commands")
        self.audio = self.bus.bind_router(LOCAL, "audio")
        self.phones = self.bus.bind_publisher(LOCAL, "phones")
        self.faps = self.bus.bind_publisher(LOCAL, "faps")
        self.events = self.bus.bind_publisher(LOCAL, "events")
        self.audio_endpoint = self.audio.endpoint
        self.running = ["recognizer", "synthesizer"]
        self.refuse = False
        self.received: list[Message] = []
        self.audio_messages: list[AudioChunk] = []
        self.audio_sender = Peer()
        self._poller = Poller()
        self._jobs: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._stop = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self._stop = True
        self._thread.join()
        self.bus.close()

    def do(self, job: Callable[[], object]) -> None:
        """Run a job on the thread that owns the sockets, and wait until it is done."""
        done = threading.Event()
        self._jobs.put(job)
        self._jobs.put(done.set)
        assert done.wait(60)

    def publish(self, publisher: Socket, *messages: Message) -> None:
        """Publish messages."""
        self.do(lambda: [publisher.send(message) for message in messages])

    def bind_audio(self) -> None:
        """Start a recognizer at the address that clients are given."""
        self.audio = self.bus.bind_router(self.audio_endpoint, "audio")
        self._poller.add(self.audio)

    def sessions_of(self, kind: type[Message]) -> list[str]:
        """Return the sessions of the received messages of a kind."""
        return [message.session for message in self.received if isinstance(message, kind)]

    def on_open(self, opening: OpenSession, client: Peer) -> None:
        """Open a session."""
        self.answer_open(opening, client, opening.session or f"s{len(self.received)}")

    def answer_open(self, opening: OpenSession, client: Peer, session: str) -> None:
        """Tell the client that its session is open."""
        opened = SessionOpened(
            session=session,
            epoch=1,
            request=opening.request,
            token=TOKEN,
            audio=self.audio_endpoint,
            phones=self.phones.endpoint,
            faps=self.faps.endpoint,
            events=self.events.endpoint,
            facts=SessionFacts(language="mandarin", frame_rate_hz=50.0),
        )
        self.commands.send(opened, to=client)

    def on_message(self, message: Message, sender: Peer) -> None:
        """Handle a message to control; subclasses handle more kinds."""
        match message:
            case OpenSession() if self.refuse:
                refusal = Error(code="no-service", text="start one", request=message.request)
                self.commands.send(refusal, to=sender)
            case OpenSession():
                self.on_open(message, sender)
            case StatusRequest():
                self.commands.send(self._status(message), to=sender)
            case CloseSession() | FlushSession() | SetFace() if message.request is not None:
                done = Done(session=message.session, request=message.request)
                self.commands.send(done, to=sender)

    def _run(self) -> None:
        for socket in (self.commands, self.audio, self.phones, self.faps, self.events):
            self._poller.add(socket)
        while not self._stop:
            while not self._jobs.empty():
                self._jobs.get()()
            for socket in self._poller.wait(0.005):
                for received in socket.receive():
                    message = received.message
                    if socket is self.commands and isinstance(message, Message):
                        self.received.append(message)
                        self.on_message(message, received.sender)
                    elif isinstance(message, AudioChunk):
                        self.audio_messages.append(message)
                        self.audio_sender = received.sender
                        taken = Acknowledge(session=message.session, sequence=message.sequence)
                        self.audio.send(taken, to=received.sender)

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
