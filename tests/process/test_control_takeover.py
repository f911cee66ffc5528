"""A restarted control learns the sessions from the services."""

import time

import pytest
from kouxing_client.messages import Message, Speech

from kouxing.services.control import restart_recovery, session_lifecycle
from kouxing.shared.fast_record import replace
from kouxing.shared.network.sockets import Socket
from kouxing.shared.wire.control import (
    Heartbeat,
    HeartbeatReply,
    SessionProgress,
    SessionStarted,
    StartSession,
)
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    OpenSession,
    SessionMoved,
    SessionOpened,
)
from tests.control_harness import ControlHarness, make_heartbeat
from tests.samples import START

PLACED = dict.fromkeys(("audio", "phones", "phone_input", "faps"), "tcp://127.0.0.1:1")
ELSEWHERE = {**PLACED, "audio": "tcp://127.0.0.1:2"}


@pytest.fixture(autouse=True)
def _longer_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Extend the time limits of control for slow machines."""
    monkeypatch.setattr(restart_recovery, "RECOVERY_S", 60.0)
    monkeypatch.setattr(session_lifecycle, "START_TIMEOUT_S", 60.0)
    monkeypatch.setattr(session_lifecycle, "OBSERVER_TIMEOUT_S", 60.0)


def report(
    endpoints: dict[str, str] = PLACED, face: FaceSettings = START.opening.face
) -> SessionStarted:
    """Return the report of a session that an earlier control has placed on these services."""
    start = replace(START.with_face(face), session="mine", epoch=4, endpoints=endpoints)
    return SessionStarted(session="mine", request="r", start=start)


def test_control_restores_a_session_unchanged(harness: ControlHarness, client: Socket) -> None:
    recognizer, synthesizer = harness.services
    harness.receive(synthesizer)  # its heartbeat is answered
    harness.receive(recognizer)
    face = FaceSettings(lip_model="learned", expressiveness=1.5)
    recognizer.send(report(face=face))
    for service in harness.services:
        (start,) = harness.receive(service)
        assert isinstance(start, StartSession)
        assert (start.session, start.epoch, start.token) == ("mine", 4, "t")
        assert start.opening.face == face
    client.send(CloseSession(session="mine", token="t", request="1"))
    assert harness.receive(client) == [Done(session="mine", request="1")]


@pytest.mark.parametrize("reported", [("speaker", "listener"), ("listener", "speaker")])
@pytest.mark.parametrize("has_speech", [True, False])
def test_a_restored_face_follows_the_session_that_it_listens_to(
    harness: ControlHarness, reported: tuple[str, str], has_speech: bool
) -> None:
    recognizer, synthesizer = harness.services
    starts = {
        "speaker": replace(START, speech_time=5 if has_speech else None),
        "listener": START.with_face(FaceSettings(listen_to="speaker", listening=not has_speech)),
    }
    for name in reported:
        start = replace(starts[name], session=name, epoch=4, endpoints=PLACED)
        recognizer.send(SessionStarted(session=name, request="r", start=start))
    received: list[Message] = []
    while len(harness.control._sessions) < 2:
        received += harness.receive(synthesizer)
    assert harness.control._sessions.find("listener").face.settings.listening == has_speech
    synthesizer.send(replace(make_heartbeat("synthesizer"), sent_ns=1))
    while not any(isinstance(item, HeartbeatReply) and item.sent_ns == 1 for item in received):
        received += harness.receive(synthesizer)
    changes = [item.face for item in received if isinstance(item, SetFace)]
    assert changes[-1].listening == has_speech


def test_defers_a_request_until_its_session_is_restored(
    harness: ControlHarness, client: Socket
) -> None:
    client.send(CloseSession(session="mine", token="t", request="1"))
    while not harness.control._requests._deferred:
        harness.control.step(0.01)
    harness.services[0].send(report())
    assert harness.receive(client) == [Done(session="mine", request="1")]


@pytest.mark.parametrize("sender", ["synthesizer", "recognizer elsewhere"])
def test_only_the_recognizer_of_a_session_may_report_it(
    harness: ControlHarness, client: Socket, sender: str
) -> None:
    recognizer, synthesizer = harness.services
    service = synthesizer if sender == "synthesizer" else recognizer
    harness.receive(service)
    service.send(report() if service is synthesizer else report(ELSEWHERE))
    service.send(make_heartbeat(sender.partition(" ")[0]))
    harness.receive(service)  # the report was read before the heartbeat
    harness.control._recovery.end_s = 0.0
    client.send(CloseSession(session="mine", token="t", request="1"))
    (answer,) = harness.receive(client)
    assert isinstance(answer, Error)
    assert answer.code == "unknown-session"


def test_moves_a_session_without_synthesizer_at_the_deadline(harness: ControlHarness) -> None:
    recognizer, synthesizer = harness.services
    recognizer.send(report({**PLACED, "faps": "tcp://127.0.0.1:3"}))
    harness.step_until(lambda: harness.control._recovery._reported)
    harness.control._recovery.end_s = 0.0
    starts: list[StartSession] = []
    while not starts or starts[-1].epoch == 4:
        told = harness.receive(synthesizer)
        starts += [message for message in told if isinstance(message, StartSession)]
    assert starts[-1].epoch == 5
    assert starts[-1].endpoints["faps"] == PLACED["faps"]


def test_stops_unknown_sessions_only_after_the_deadline(harness: ControlHarness) -> None:
    recognizer, _ = harness.services
    harness.receive(recognizer)
    serving = make_heartbeat("recognizer", sessions={"mine": SessionProgress()})
    recognizer.send(serving)
    (seen,) = harness.receive(recognizer)
    assert not isinstance(seen, CloseSession)
    harness.control._recovery.end_s = 0.0
    while harness.control._recovery.is_active:
        harness.control.step(0.02)
    recognizer.send(serving)
    assert CloseSession(session="mine") in harness.receive(recognizer, 2)


def test_late_speech_of_an_ended_session_does_not_affect_its_successor(
    harness: ControlHarness, client: Socket
) -> None:
    recognizer, _ = harness.services
    harness.receive(recognizer)
    client.send(OpenSession(session="mine", request="1"))
    harness.receive(recognizer)
    recognizer.send(Speech(session="mine", epoch=1, sequence=9, media_time=2840, active=True))
    recognizer.send(make_heartbeat("recognizer"))
    harness.receive(recognizer)
    assert not harness.control._sessions.find("mine").is_speaking


def test_repeats_session_moved_to_the_client(
    harness: ControlHarness, client: Socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_lifecycle, "REPEAT_AFTER_S", (0.1, 0.2))
    recognizer, synthesizer = harness.services
    client.send(OpenSession(session="mine", request="1"))
    for service in harness.services:
        _, start = harness.receive(service, 2)
        assert isinstance(start, StartSession)
        service.send(SessionStarted(session="mine", request=start.request))
    harness.receive(client)
    for media_time in (2840, 5000):  # a continuing recognizer repeats it
        speech = Speech(session="mine", epoch=1, sequence=1, media_time=media_time, active=True)
        recognizer.send(speech)
    recognizer.send(make_heartbeat("recognizer"))
    harness.receive(recognizer)  # the synthesizer's, over another connection, might overtake speech
    synthesizer.send(make_heartbeat("synthesizer", "tcp://127.0.0.1:9"))
    for service in reversed(harness.services):  # the recognizer last
        starts: list[StartSession] = []
        while not starts:
            told = harness.receive(service)
            starts = [message for message in told if isinstance(message, StartSession)]
        assert starts[0].speech_time == 2840
        service.send(SessionStarted(session="mine", request=starts[0].request))
    first, *others = harness.receive(client, 3)
    assert isinstance(first, SessionMoved)
    assert (first.epoch, first.faps) == (2, "tcp://127.0.0.1:9")
    assert others == [first, first]


def test_speech_may_end_while_a_session_moves_to_another_synthesizer(
    harness: ControlHarness, client: Socket
) -> None:
    recognizer, _ = harness.services
    other = harness.buses[1].connect_dealer(harness.control.endpoints["commands"])
    heartbeat = make_heartbeat("synthesizer", "tcp://127.0.0.1:10")
    other.send(replace(heartbeat, instance="synthesizer-2"))
    harness.receive(other)
    client.send(OpenSession(session="mine", request="1"))
    harness.step_until(lambda: client.wait(0.0))
    record = harness.control._sessions.find("mine")
    record.is_speaking = True
    harness.control._remove_service("synthesizer", "no heartbeat")
    assert record.epoch == 2  # the recognizer does not have this epoch yet
    recognizer.send(Speech(session="mine", epoch=1, sequence=1, active=False))
    harness.step_until(lambda: not record.is_speaking)


@pytest.mark.parametrize("num_free", [1, 2])
def test_a_session_leaves_a_worker_that_rejects_its_move(
    harness: ControlHarness, client: Socket, num_free: int
) -> None:
    bus = harness.buses[1]
    free = [bus.connect_dealer(harness.control.endpoints["commands"]) for _ in range(num_free)]
    for number, synthesizer in enumerate(free):
        heartbeat = make_heartbeat("synthesizer", f"tcp://127.0.0.1:{10 + number}")
        synthesizer.send(replace(heartbeat, instance=f"synthesizer-{number}"))
        harness.receive(synthesizer)
    client.send(OpenSession(session="mine", request="1"))
    harness.step_until(lambda: client.wait(0.0))
    harness.receive(client)
    record = harness.control._sessions.find("mine")
    harness.control._remove_service("synthesizer", "no heartbeat")
    for epoch, synthesizer in enumerate(free, 2):
        (start,) = harness.receive(synthesizer)
        assert isinstance(start, StartSession)
        assert start.epoch == epoch
        synthesizer.send(
            Error(session="mine", request=start.request, code="no-service", text="no model")
        )
    harness.step_until(lambda: harness.control._sessions.get("mine") is None)
    assert record.rejected_by == {f"synthesizer-{number}" for number in range(num_free)}


@pytest.mark.parametrize("missed", ["move", "move of a restored session", "end"])
def test_an_observer_that_was_lost_receives_what_it_missed(
    harness: ControlHarness, client: Socket, missed: str
) -> None:
    observer = harness.buses[0].connect_dealer(harness.control.endpoints["commands"])
    harness.services.append(observer)
    lamp = Heartbeat(
        service="recognizer", instance="lamp", role="observer", state="ready", sent_ns=0
    )
    observer.send(lamp)
    harness.receive(observer)
    if missed == "move of a restored session":
        harness.services[0].send(report())
        assert isinstance(harness.receive(observer)[0], StartSession)
    else:
        client.send(OpenSession(session="mine", request="1"))
        harness.step_until(lambda: client.wait(0.0))
        (opened,) = harness.receive(client)
        assert isinstance(opened, SessionOpened)
    harness.control._remove_service("lamp", "no heartbeat")
    record = harness.control._sessions.find("mine")
    if missed.startswith("move"):
        assert harness.control._sessions.move(record, time.monotonic())
    else:  # another session with the same name
        client.send(CloseSession(session="mine", token=record.token, request="2"))
        harness.receive(client)
        client.send(OpenSession(session="mine", request="3"))
        harness.step_until(lambda: client.wait(0.0))
        record = harness.control._sessions.find("mine")
    observer.send(replace(lamp, sessions={"mine": SessionProgress()}))
    messages = harness.receive(observer, 2)
    (start,) = (message for message in messages if isinstance(message, StartSession))
    assert (start.token, start.epoch) == (record.token, record.epoch)
