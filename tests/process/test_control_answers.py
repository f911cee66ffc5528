"""Control repeats an answer, with its token, only to the client that sent the request."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq
from kouxing_client.messages import Message, Speech

from kouxing.services.control import session_lifecycle
from kouxing.shared.fast_record import replace
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.sockets import Socket
from kouxing.shared.settings.keys import add_key, load_user_key, read_key, revoke_key
from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.control import HeartbeatReply, SessionProgress
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.session import CloseSession, Error, OpenSession, SessionOpened
from tests.control_harness import IDLE_LIMIT_S, ControlHarness, make_heartbeat
from tests.system import wait_until


@pytest.fixture(params=[True, False])
def harness(request: pytest.FixtureRequest, new_keys: None) -> Iterator[ControlHarness]:
    new_harness = ControlHarness(insecure=request.param)
    yield new_harness
    new_harness.close()


def test_a_reply_to_a_heartbeat_states_the_idle_limit(harness: ControlHarness) -> None:
    (reply,) = harness.receive(harness.services[0])
    assert isinstance(reply, HeartbeatReply)
    assert reply.idle_limit_s == IDLE_LIMIT_S


def test_a_repeated_request_gets_the_same_answer(harness: ControlHarness) -> None:
    client = harness.connect_client(harness.control.key and load_user_key())
    first = harness.open(client, "mine")
    assert isinstance(first, SessionOpened)
    assert harness.open(client, "mine") == first


def test_a_session_opens_without_an_observer_that_does_not_answer(
    harness: ControlHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_lifecycle, "START_TIMEOUT_S", 3600.0)
    lamp = make_heartbeat("recognizer", role="observer", instance="lamp")
    observer = harness.buses[0].connect_dealer(harness.control.endpoints["commands"])
    observer.send(lamp)
    harness.receive(observer)
    client = harness.connect_client(harness.control.key and load_user_key())
    assert isinstance(harness.open(client, "mine"), SessionOpened)


@pytest.mark.parametrize("harness", [False], indirect=True)
def test_sessions_end_when_their_key_is_revoked(harness: ControlHarness, tmp_path: Path) -> None:
    add_key("laptop", ["client"], tmp_path / "laptop.key")
    laptop = harness.connect_client(read_key(tmp_path / "laptop.key"))
    assert isinstance(harness.open(laptop, "revoked"), SessionOpened)
    with Bus(load_user_key()) as bus:
        client = bus.connect_dealer(harness.control.endpoints["commands"])
        client.send(OpenSession(request="2", session="kept"))
        harness.step_until(lambda: client.wait(0.0))
        revoke_key("laptop")
        harness.step_until(lambda: harness.control._sessions.get("revoked") is None)
        assert harness.control._sessions.get("kept") is not None


def test_a_service_can_refuse_a_session(harness: ControlHarness) -> None:
    client = harness.connect_client(harness.control.key and load_user_key())
    harness.refusal = Error(code="busy", text="too many videos", retry_after_s=5.0)
    refused = harness.open(client, "mine")
    assert isinstance(refused, Error)
    assert (refused.code, refused.text, refused.retry_after_s) == ("busy", "too many videos", 5.0)
    assert refused.request == "1"
    harness.refusal = None
    assert isinstance(harness.open(client, "mine", "2"), SessionOpened)


class ControlProxy:
    """Forwards connections to control. A proxy that is not open holds the received data."""

    def __init__(self, port: int) -> None:
        self._port = port
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.is_open = threading.Event()
        self.is_open.set()
        self.ends: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._start(self._accept)

    def close(self) -> None:
        self.is_open.set()
        self.cut()
        self.listener.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for end in (self.listener, *self.ends):
            end.close()

    def cut(self) -> None:
        for end in self.ends:
            with contextlib.suppress(OSError):  # ended already
                end.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                incoming, _ = self.listener.accept()
                outgoing = socket.create_connection(("127.0.0.1", self._port))
                self.ends += [incoming, outgoing]
                for ends in ((incoming, outgoing), (outgoing, incoming)):
                    self._start(self._forward, *ends)

    def _start(self, work: Callable[..., None], *ends: socket.socket) -> None:
        self._threads.append(threading.Thread(target=work, args=ends, daemon=True))
        self._threads[-1].start()

    def _forward(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self.is_open.wait()
                sink.sendall(data)
            sink.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def proxy(harness: ControlHarness) -> Iterator[ControlProxy]:
    port = harness.control.endpoints["commands"].partition(" ")[0].rpartition(":")[2]
    with contextlib.closing(ControlProxy(int(port))) as new_proxy:
        yield new_proxy


def disconnect_before_the_answer(
    harness: ControlHarness, proxy: ControlProxy
) -> tuple[zmq.Socket[bytes], str]:
    """Return a client that misses the answer to its request, and the token in that answer."""
    address = f"tcp://127.0.0.1:{proxy.listener.getsockname()[1]}"
    client = harness.connect_client(harness.control.key and load_user_key(), address)
    client.send_multipart(encode(OpenSession(request="1", session="mine")))
    harness.step_until(lambda: harness.control._sessions.get("mine"))
    proxy.is_open.clear()
    lost = harness.control._sessions.find("mine")
    harness.step_until(lambda: lost.is_announced)
    proxy.cut()
    proxy.is_open.set()
    harness.step_until(lambda: not harness.control._commands.is_open(lost.client.connection))
    return client, lost.token


def test_a_client_that_missed_the_answer_opens_the_session_again(
    harness: ControlHarness, proxy: ControlProxy
) -> None:
    client, lost = disconnect_before_the_answer(harness, proxy)
    opened = harness.open(client, "mine")
    assert isinstance(opened, SessionOpened)
    assert opened.token not in ("", lost)
    assert len(harness.control._sessions) == 1
    assert harness.open(client, "mine") == opened


def test_a_session_with_audio_is_not_opened_again(
    harness: ControlHarness, proxy: ControlProxy
) -> None:
    client, _ = disconnect_before_the_answer(harness, proxy)
    record = harness.control._sessions.find("mine")
    recognizer = replace(
        harness.control._registry["recognizer"].heartbeat,
        sessions={"mine": SessionProgress(last_droppable_sequence=1)},
    )
    endpoints = dict.fromkeys(recognizer.endpoints, "tcp://127.0.0.1:1")
    harness.services[0].send(replace(recognizer, endpoints=endpoints))
    harness.step_until(lambda: record.next_sequence == 2)
    assert getattr(harness.open(client, "mine"), "code", "") == "session-exists"


def test_a_connection_with_a_stolen_routing_id_gets_no_old_answer(harness: ControlHarness) -> None:
    key = harness.control.key and load_user_key()
    assert isinstance(harness.open(harness.connect_client(key), "mine"), SessionOpened)
    stolen = harness.open(harness.connect_client(key), "mine")
    assert getattr(stolen, "code", "") == "session-exists"


def request(harness: ControlHarness, client: zmq.Socket[bytes], message: Message) -> None:
    """Send a request and wait for its answer."""
    client.send_multipart(encode(message))
    wait_until(lambda: client.poll(0), step=lambda: harness.control.step(0.01))
    client.recv_multipart()


def send_speech(harness: ControlHarness, *, active: bool) -> None:
    """Send control the start or the end of speech in the session ``speaker``."""
    record = harness.control._sessions.find("speaker")
    harness.services[0].send(Speech(session="speaker", epoch=1, sequence=1, active=active))
    wait_until(lambda: record.is_speaking == active, step=lambda: harness.control.step(0.01))


def receive_listening(harness: ControlHarness, synthesizer: Socket, num: int) -> list[bool]:
    """Return the next values of ``listening`` for the session ``listener``."""
    listening: list[bool] = []
    while len(listening) < num:
        for message in harness.receive(synthesizer):
            if isinstance(message, SetFace) and message.face.listening is not None:
                assert message.session == "listener"
                listening.append(message.face.listening)
    return listening


@pytest.fixture
def listening_to(harness: ControlHarness) -> zmq.Socket[bytes]:
    """Open the sessions ``speaker`` and ``listener``; return their client."""
    client = harness.connect_client(harness.control.key and load_user_key())
    harness.open(client, "speaker")
    harness.open(client, "listener", "2")
    return client


LISTEN = SetFace(session="listener", face=FaceSettings(listen_to="speaker"), request="3")


@pytest.mark.parametrize("harness", [True], indirect=True)
def test_a_face_is_notified_when_the_session_that_it_listens_to_speaks(
    harness: ControlHarness, listening_to: zmq.Socket[bytes]
) -> None:
    request(harness, listening_to, LISTEN)
    harness.services[0].send(Speech(session="speaker", epoch=1, sequence=1, active=True))
    harness.services[0].send(Speech(session="speaker", epoch=1, sequence=2, active=False))
    assert receive_listening(harness, harness.services[1], 3) == [False, True, False]


@pytest.mark.parametrize("harness", [True], indirect=True)
@pytest.mark.parametrize("end", ["its session closes", "the face no longer listens"])
def test_a_face_stops_listening_during_speech(
    harness: ControlHarness, listening_to: zmq.Socket[bytes], end: str
) -> None:
    request(harness, listening_to, LISTEN)
    send_speech(harness, active=True)
    assert receive_listening(harness, harness.services[1], 2) == [False, True]
    if end == "its session closes":
        token = harness.control._sessions.find("speaker").token
        request(harness, listening_to, CloseSession(session="speaker", token=token, request="4"))
    else:
        face = FaceSettings(listen_to="")
        request(harness, listening_to, SetFace(session="listener", face=face, request="4"))
    assert receive_listening(harness, harness.services[1], 1) == [False]


@pytest.mark.parametrize("harness", [True], indirect=True)
def test_a_face_is_notified_of_speech_that_started_before(
    harness: ControlHarness, listening_to: zmq.Socket[bytes]
) -> None:
    send_speech(harness, active=True)
    request(harness, listening_to, LISTEN)
    assert receive_listening(harness, harness.services[1], 1) == [True]
    start = harness.control._sessions.find("listener").start_message(time.monotonic())
    assert start.opening.face.listening  # for another synthesizer
