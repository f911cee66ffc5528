"""Peers that say anything to a service's sockets: it goes on and answers the next one."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from functools import cache
from typing import Any, TypeVar

import pytest
import zmq
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from kouxing.services.control.config import ControlConfig
from kouxing.services.control.service import ControlService
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.service import RecognizerService
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.service import SynthesizerService
from kouxing.shared.bus import Bus
from kouxing.shared.errors import UserError
from kouxing.shared.service import Service
from kouxing.shared.sockets import Socket
from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.control import (
    Heartbeat,
    SessionInput,
    SessionStarted,
    StartSession,
)
from kouxing.shared.wire.message import MAX_AUDIO_BYTES, Message
from kouxing.shared.wire.session import Error, OpenSession, StatusReport, StatusRequest
from tests.samples import SAMPLES
from tests.system import free_port

pytestmark = pytest.mark.property

AnyMessage = TypeVar("AnyMessage", bound=Message)

LOCAL = "tcp://127.0.0.1:*"
MAX_SESSIONS = 4
WORKERS = [
    Heartbeat(
        service=service,
        instance=f"{service}-1",
        role="worker",
        state="ready",
        sent_ns=0,
        endpoints={name: f"tcp://127.0.0.1:{port}" for port, name in enumerate(names, start=1)},
    )
    for service, names in
    (("recognizer", ("audio", "phones")), ("synthesizer", ("faps", "phone_input")))
]  # fmt: skip
START = dataclasses.replace(
    next(sample for sample in SAMPLES if isinstance(sample, StartSession)),
    paced=False,
    endpoints={"phone_input": f"tcp://127.0.0.1:{free_port()}"},
)

TEXTS = st.sampled_from(
    ["", "demo", "t", "recognizer-1", "worker", "observer", "draining", "ready", "start-demo-1",
     "learnt", "f32le", "tcp://-:1", "tcp://*:1", "tcp://127.0.0.1:1", "ipc:///tmp/x", "../x",
     "x" * 2000, "\0", "人"]
)  # fmt: skip
NUMBERS = st.sampled_from([0, 1, 2, 7, 8, 320, 2**31, 2**40, 2**53, -1, 2**63])
REALS = st.sampled_from([0.0, 0.5, -1.0, 1e9, 1e300, math.nan, math.inf])
DATA = st.one_of(
    st.binary(max_size=300),
    st.integers(0, MAX_AUDIO_BYTES + 1).map(bytes),
    st.sampled_from([b"\xff" * 272, b"\x00\x00\x80\x7f" * 28, b"\xff" * 9]),
)
MAPS = st.dictionaries(
    st.one_of(TEXTS, st.sampled_from(["audio", "phones", "faps", "phone_input"])),
    st.one_of(TEXTS, REALS, st.builds(SessionInput, idle_s=REALS, sequence=NUMBERS)),
    max_size=4,
)


def values_like(value: object) -> st.SearchStrategy[Any]:
    by_type: list[tuple[type, st.SearchStrategy[Any]]] = [
        (bool, st.booleans()), (int, NUMBERS), (float, REALS), (str, TEXTS), (bytes, DATA),
        (dict, MAPS), (list, st.lists(TEXTS, max_size=3)),
    ]  # fmt: skip
    return next((values for kind, values in by_type if isinstance(value, kind)), st.none())


@st.composite
def messages(draw: st.DrawFn) -> Message:
    """Draw a message of any kind in which some fields hold what they should not."""
    sample = draw(st.sampled_from(SAMPLES))
    names = [field.name for field in dataclasses.fields(sample)]
    changed = draw(st.lists(st.sampled_from(names), max_size=3, unique=True))
    values = {name: draw(values_like(getattr(sample, name))) for name in changed}
    return dataclasses.replace(sample, **values)


class Peers(RuleBasedStateMachine):
    """Peers of one ROUTER socket and, as subscribers, of one XPUB socket of a service."""

    service: Service
    router: Socket
    publisher: Socket

    def __init__(self) -> None:
        super().__init__()
        self.bus, self.context = Bus(), zmq.Context()
        self.num_asked = 0

    def begin(self) -> None:
        self.honest = self.bus.connect_dealer(self.router.endpoint)
        self.hostile: zmq.Socket[bytes] = self.context.socket(zmq.DEALER)
        self.subscriber: zmq.Socket[bytes] = self.context.socket(zmq.XSUB)
        for socket in (self.hostile, self.subscriber):
            socket.setsockopt(zmq.LINGER, 0)
        self.hostile.connect(self.router.endpoint)
        self.subscriber.connect(self.publisher.endpoint)

    def teardown(self) -> None:
        self.bus.close()
        self.context.destroy(linger=0)

    @rule(message=messages())
    def send_a_message(self, message: Message) -> None:
        self.hostile.send_multipart(encode(message))

    @rule(parts=st.lists(st.binary(max_size=300), min_size=1, max_size=6))
    def send_parts(self, parts: list[bytes]) -> None:
        self.hostile.send_multipart(parts)

    @rule(topic=st.binary(max_size=140), begins=st.booleans())
    def subscribe(self, topic: bytes, begins: bool) -> None:
        self.subscriber.send(bytes([begins]) + topic)

    @rule(parts=st.lists(st.binary(max_size=140), min_size=1, max_size=6))
    def send_to_the_publisher(self, parts: list[bytes]) -> None:
        self.subscriber.send_multipart(parts)

    @rule(name=st.binary(min_size=1, max_size=4))
    def come_by_another_name(self, name: bytes) -> None:
        self.hostile.close(linger=100)
        self.hostile = self.context.socket(zmq.DEALER)
        self.hostile.setsockopt(zmq.ROUTING_ID, b"x" + name)
        self.hostile.connect(self.router.endpoint)

    def answer(self, kind: type[AnyMessage]) -> AnyMessage:
        """Ask as an honest peer; return what comes of a kind."""
        self.num_asked += 1
        self.honest.send(StatusRequest(request=f"ask-{self.num_asked}"))
        end_s = time.monotonic() + 20
        while time.monotonic() < end_s:
            self.service.step(0.001)
            for received in self.honest.receive():
                if isinstance(received.message, kind):
                    return received.message
        raise AssertionError("the service does not answer")


class PeersOfControl(Peers):
    @initialize()
    def start(self) -> None:
        config = ControlConfig(
            control=LOCAL, events=LOCAL, insecure=True, max_sessions=MAX_SESSIONS
        )
        service = ControlService(config)
        self.service, self.router, self.publisher = service, service._commands, service._events
        self.begin()
        for worker in WORKERS:
            self.honest.send(worker)
        self.honest.send(OpenSession(session="demo", request="open"))

    @rule(message=messages())
    def send_as_a_worker(self, message: Message) -> None:
        for each in (*WORKERS, message):
            self.hostile.send_multipart(encode(each))

    @rule()
    def start_sessions(self) -> None:
        self.honest.send(SessionStarted(session="demo", request="start-demo-1"))

    @invariant()
    def it_tells_the_status(self) -> None:
        assert len(self.answer(StatusReport).sessions) <= MAX_SESSIONS

    def teardown(self) -> None:
        self.service.bus.close()
        super().teardown()


@cache
def recognizer() -> RecognizerService:
    control = f"tcp://127.0.0.1:{free_port()}"
    config = RecognizerConfig(
        audio=LOCAL, phones=LOCAL, unpaced_audio=LOCAL, control=control, insecure=True
    )
    return RecognizerService(config)


@cache
def synthesizer() -> SynthesizerService:
    control = f"tcp://127.0.0.1:{free_port()}"
    config = SynthesizerConfig(phone_input=LOCAL, faps=LOCAL, control=control, insecure=True)
    return SynthesizerService(config)


class PeersOfAWorker(Peers):
    @rule(sequence=NUMBERS, epoch=st.sampled_from([0, 1, 2]))
    def start_the_session_anew(self, sequence: int, epoch: int) -> None:
        start = dataclasses.replace(START, epoch=epoch, token=f"t{sequence}"[:1])
        self.service.start_session(start)

    @rule(endpoint=TEXTS, epoch=st.sampled_from([1, 2]))
    def start_with_an_endpoint_of_a_hostile_worker(self, endpoint: str, epoch: int) -> None:
        endpoints = {"phone_input": endpoint}
        with contextlib.suppress(UserError):  # which control is told
            self.service.start_session(dataclasses.replace(START, epoch=epoch, endpoints=endpoints))

    @invariant()
    def it_answers(self) -> None:
        self.answer(Error)

    def teardown(self) -> None:
        self.service.stop_session("demo")
        super().teardown()


class PeersOfTheRecognizer(PeersOfAWorker):
    @initialize()
    def start(self) -> None:
        self.service = recognizer()
        self.router, self.publisher = self.service._audio, self.service._phones
        self.service.start_session(START)
        self.begin()


class PeersOfTheSynthesizer(PeersOfAWorker):
    @initialize()
    def start(self) -> None:
        self.service = synthesizer()
        self.router, self.publisher = self.service._input, self.service._faps
        self.service.start_session(START)
        self.begin()


for machine in (PeersOfControl, PeersOfTheRecognizer, PeersOfTheSynthesizer):
    machine.TestCase.settings = settings(max_examples=25, stateful_step_count=20)
TestPeersOfControl = PeersOfControl.TestCase
TestPeersOfTheRecognizer = PeersOfTheRecognizer.TestCase
TestPeersOfTheSynthesizer = PeersOfTheSynthesizer.TestCase
