"""Peers send anything to a service's sockets: it continues and answers the next request."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, cast

import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st
from kouxing_client.field_types import MAX_AUDIO_BYTES
from kouxing_client.messages import Message

from kouxing.services.control.config import ControlConfig
from kouxing.services.control.service import ControlService
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.service import RecognizerService
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.service import SynthesizerService
from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.network import connection_limits, peer_connection, sockets
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.sockets import Socket
from kouxing.shared.service.base import Service
from kouxing.shared.service.session_service import SessionService
from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.control import SessionProgress, SessionStarted, StartSession
from kouxing.shared.wire.session import Error, OpenSession, StatusReport, StatusRequest
from tests.control_harness import ENDPOINTS_BY_SERVICE, LOCAL, make_heartbeat
from tests.samples import SAMPLES, with_opening
from tests.system import free_port

NO_CONTROL = f"tcp://127.0.0.1:{free_port()}"
MAX_SESSIONS = 4
WORKERS = [replace(make_heartbeat(kind), instance=f"{kind}-1") for kind in ENDPOINTS_BY_SERVICE]
START = replace(
    with_opening(cast(StartSession, SAMPLES["start-session"]), paced=False),
    endpoints={"phone_input": f"tcp://127.0.0.1:{free_port()}"},
)

TEXTS = st.sampled_from(
    ["", "demo", "t", "recognizer-1", "worker", "observer", "draining", "ready", "start-0-1",
     "learned", "f32le", "tcp://-:1", "tcp://*:1", "tcp://127.0.0.1:1", "ipc:///tmp/x", "../x",
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
    st.one_of(TEXTS, REALS, st.builds(SessionProgress, idle_s=REALS, final_until=NUMBERS)),
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
    """Draw a message of any kind, of which up to three fields have invalid values."""
    sample = draw(st.sampled_from([*SAMPLES.values()]))
    names = sample.__struct_fields__
    changed = draw(st.lists(st.sampled_from(names), max_size=3, unique=True))
    values = {name: draw(values_like(getattr(sample, name))) for name in changed}
    return replace(sample, **values)


PARTS = st.lists(st.binary(max_size=300), min_size=1, max_size=6)
ACTIONS = st.lists(
    st.one_of(
        st.tuples(st.just("send"), st.one_of(messages().map(encode), PARTS)),
        st.tuples(st.just("subscribe"), st.builds(lambda on, topic: [bytes([on]) + topic],
                                                  st.booleans(), st.binary(max_size=140))),
        st.tuples(st.just("subscribe"), PARTS),
        st.tuples(st.just("rename"), st.binary(min_size=1, max_size=4)),
        st.tuples(st.just("start"), st.builds(
            lambda token, epoch, endpoint: replace(
                START, token=token, epoch=epoch, endpoints={"phone_input": endpoint}),
            st.sampled_from(["t", "7"]), st.integers(0, 2),
            st.one_of(st.just(START.endpoints["phone_input"]), TEXTS))),
    ),
    max_size=20,
)  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def _no_penalties() -> Iterator[None]:
    """Let disconnected peers connect again at once: the honest peer has the same address."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (connection_limits, peer_connection, sockets):
            patch.setattr(module, "PENALTY_S", 0.0)
        for module in (peer_connection, sockets):
            patch.setattr(module, "LONG_PENALTY_S", 0.0)
        yield


class Peers:
    """A hostile and an honest peer of a ROUTER socket and of an XPUB socket of a service."""

    def __init__(self, service: Service, router: Socket, publisher: Socket) -> None:
        self.service, self.router = service, router
        self.bus, self.context = Bus(), zmq.Context()
        self.honest = self.bus.connect_dealer(router.endpoint)
        self.subscriber = self._connect(zmq.XSUB, publisher.endpoint)
        self.hostile = self._connect(zmq.DEALER, router.endpoint)

    def _connect(self, kind: int, endpoint: str, routing_id: bytes = b"") -> zmq.Socket[bytes]:
        socket = self.context.socket(kind)
        socket.setsockopt(zmq.LINGER, 100)
        if routing_id:
            socket.setsockopt(zmq.ROUTING_ID, routing_id)
        socket.connect(endpoint)
        return socket

    def close(self) -> None:
        self.bus.close()
        self.context.destroy(linger=0)

    def send(self, parts: list[bytes]) -> None:
        self.hostile.send_multipart(parts)

    def subscribe(self, parts: list[bytes]) -> None:
        self.subscriber.send_multipart(parts)

    def rename(self, name: bytes) -> None:
        self.hostile.close()
        self.hostile = self._connect(zmq.DEALER, self.router.endpoint, b"x" + name)

    def start(self, message: StartSession) -> None:
        """Start a session, perhaps at the endpoint of a hostile worker."""
        assert isinstance(self.service, SessionService)
        with contextlib.suppress(UserError):  # control gets the reason
            self.service.start_session(message)

    def check_answer(self, kind: type[Message]) -> Any:
        """Send a request as the honest peer; return the answer."""
        self.honest.send(StatusRequest(request="is there an answer?"))
        end_s = time.monotonic() + 60
        while time.monotonic() < end_s:
            self.service.step(0.001)
            for received in self.honest.receive():
                if isinstance(received.message, kind):
                    return received.message
        raise AssertionError("the service does not answer")

    def attack(self, actions: list[tuple[str, Any]]) -> None:
        for name, argument in actions:
            getattr(self, name)(argument)
            self.service.step(0.001)


@settings(max_examples=40)
@given(ACTIONS, st.booleans())
def test_control_answers_after_any_attack(actions: list[tuple[str, Any]], as_worker: bool) -> None:
    config = ControlConfig(control=LOCAL, events=LOCAL, insecure=True, max_sessions=MAX_SESSIONS)
    service = ControlService(config)
    peers = Peers(service, service._commands, service._events)
    for message in (*WORKERS, OpenSession(session="demo", request="open")):
        (peers.send(encode(message)) if as_worker else peers.honest.send(message))
    peers.check_answer(StatusReport)
    for action in actions:
        if action[0] == "start":
            peers.honest.send(SessionStarted(session="demo", request="start-0-1"))
        else:
            peers.attack([action])
    assert len(peers.check_answer(StatusReport).sessions) <= MAX_SESSIONS
    peers.close()
    service.bus.close()


@cache
def recognizer() -> tuple[SessionService, Socket, Socket]:
    service = RecognizerService(
        RecognizerConfig(
            audio=LOCAL, phones=LOCAL, unpaced_audio=LOCAL, control=NO_CONTROL, insecure=True
        )
    )
    return service, service._audio, service._phones


@cache
def synthesizer() -> tuple[SessionService, Socket, Socket]:
    service = SynthesizerService(
        SynthesizerConfig(phone_input=LOCAL, faps=LOCAL, control=NO_CONTROL, insecure=True)
    )
    return service, service._input, service._faps


@pytest.mark.parametrize("worker", [recognizer, synthesizer])
@settings(max_examples=25)
@given(actions=ACTIONS)
def test_a_worker_answers_after_any_attack(
    worker: Callable[[], tuple[SessionService, Socket, Socket]], actions: list[tuple[str, Any]]
) -> None:
    service, router, publisher = worker()
    peers = Peers(service, router, publisher)
    peers.start(START)
    peers.attack(actions)
    peers.check_answer(Error)
    service.stop_session("demo")
    peers.close()
