"""Control repeats an answer, with its token, only to the client that sent the request."""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq

from kouxing.shared.bus import Bus
from kouxing.shared.keys import add_key, read_key, revoke_key, user_key
from kouxing.shared.records import replace
from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.control import SessionInput
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.session import Error, OpenSession, SessionOpened
from kouxing.shared.wire.speech import Speech
from tests.control_stage import Stage


@pytest.fixture(params=[True, False])
def stage(request: pytest.FixtureRequest, new_keys: None) -> Iterator[Stage]:
    made = Stage(insecure=request.param)
    yield made
    made.close()


def test_a_repeated_request_gets_the_same_answer(stage: Stage) -> None:
    client = stage.connect_client(stage.control.key and user_key())
    first = stage.open(client, "mine")
    assert isinstance(first, SessionOpened)
    assert stage.open(client, "mine") == first


@pytest.mark.parametrize("stage", [False], indirect=True)
def test_sessions_end_when_their_key_is_revoked(stage: Stage, tmp_path: Path) -> None:
    add_key("laptop", ["client"], tmp_path / "laptop.key")
    laptop = stage.connect_client(read_key(tmp_path / "laptop.key"))
    assert isinstance(stage.open(laptop, "revoked"), SessionOpened)
    with Bus(user_key()) as bus:
        client = bus.connect_dealer(stage.control.endpoints["commands"])
        client.send(OpenSession(request="2", session="kept"))
        stage.step_until(lambda: client.wait(0.0))
        revoke_key("laptop")
        stage.step_until(lambda: stage.control._sessions.get("revoked") is None)
        assert stage.control._sessions.get("kept") is not None


def test_a_service_can_refuse_a_session(stage: Stage) -> None:
    client = stage.connect_client(stage.control.key and user_key())
    stage.refusal = Error(code="busy", text="too many videos", retry_after_s=5.0)
    refused = stage.open(client, "mine")
    assert isinstance(refused, Error)
    assert (refused.code, refused.text, refused.retry_after_s) == ("busy", "too many videos", 5.0)
    assert refused.request == "1"
    stage.refusal = None
    assert isinstance(stage.open(client, "mine", "2"), SessionOpened)


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
def link(stage: Stage) -> Iterator[ControlProxy]:
    port = stage.control.endpoints["commands"].partition(" ")[0].rpartition(":")[2]
    with contextlib.closing(ControlProxy(int(port))) as made:
        yield made


def disconnect_before_the_answer(stage: Stage, link: ControlProxy) -> tuple[zmq.Socket[bytes], str]:
    """Return a client that misses the answer to its request, and the token in that answer."""
    address = f"tcp://127.0.0.1:{link.listener.getsockname()[1]}"
    client = stage.connect_client(stage.control.key and user_key(), address)
    client.send_multipart(encode(OpenSession(request="1", session="mine")))
    stage.step_until(lambda: stage.control._sessions.get("mine"))
    link.is_open.clear()
    lost = stage.control._sessions.find("mine")
    stage.step_until(lambda: lost.announced)
    link.cut()
    link.is_open.set()
    stage.step_until(lambda: not stage.control._commands.is_open(lost.client.connection))
    return client, lost.token


def test_a_client_that_missed_the_answer_opens_the_session_again(
    stage: Stage, link: ControlProxy
) -> None:
    client, lost = disconnect_before_the_answer(stage, link)
    opened = stage.open(client, "mine")
    assert isinstance(opened, SessionOpened)
    assert opened.token not in ("", lost)
    assert len(stage.control._sessions) == 1
    assert stage.open(client, "mine") == opened


def test_a_session_with_audio_is_not_opened_again(stage: Stage, link: ControlProxy) -> None:
    client, _ = disconnect_before_the_answer(stage, link)
    record = stage.control._sessions.find("mine")
    recognizer = replace(
        stage.control._registry["recognizer"].heartbeat, sessions={"mine": SessionInput(sequence=1)}
    )
    endpoints = dict.fromkeys(recognizer.endpoints, "tcp://127.0.0.1:1")
    stage.services[0].send(replace(recognizer, endpoints=endpoints))
    stage.step_until(lambda: record.next_sequence == 2)
    assert getattr(stage.open(client, "mine"), "code", "") == "session-exists"


def test_a_connection_with_a_stolen_routing_id_gets_no_old_answer(stage: Stage) -> None:
    key = stage.control.key and user_key()
    assert isinstance(stage.open(stage.connect_client(key), "mine"), SessionOpened)
    stolen = stage.open(stage.connect_client(key), "mine")
    assert getattr(stolen, "code", "") == "session-exists"


@pytest.mark.parametrize("stage", [True], indirect=True)
def test_a_face_learns_when_the_session_that_it_listens_to_speaks(stage: Stage) -> None:
    client = stage.connect_client(stage.control.key and user_key())
    stage.open(client, "speaker")
    stage.open(client, "listener", "2")
    client.send_multipart(
        encode(SetFace(session="listener", face=FaceSettings(listen_to="speaker"), request="3"))
    )
    stage.step_until(lambda: client.poll(0))
    recognizer, synthesizer = stage.services
    for active in (True, False):
        recognizer.send(Speech(session="speaker", epoch=1, sequence=1, active=active))
    listening: list[bool] = []
    while len(listening) < 2:
        messages = stage.receive(synthesizer)
        faces = [message.face for message in messages if isinstance(message, SetFace)]
        listening += [face.listening for face in faces if face.listening is not None]
    assert listening == [True, False]
