"""A restarted control learns the sessions from the services."""

import pytest

from kouxing.services.control import lifecycle, takeover
from kouxing.shared.records import replace
from kouxing.shared.sockets import Socket
from kouxing.shared.wire.control import SessionInput, SessionStarted, StartSession
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    OpenSession,
    SessionMoved,
)
from kouxing.shared.wire.speech import Speech
from tests.control_stage import Stage, beat
from tests.samples import START

PLACED = {
    "audio": "tcp://127.0.0.1:1",
    "phones": "tcp://127.0.0.1:1",
    "phone_input": "tcp://127.0.0.1:1",
    "faps": "tcp://127.0.0.1:1",
}
ELSEWHERE = {**PLACED, "audio": "tcp://127.0.0.1:2"}


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Extend the time limits of control for slow machines."""
    monkeypatch.setattr(takeover, "TAKEOVER_S", 60.0)
    monkeypatch.setattr(lifecycle, "START_TIMEOUT_S", 60.0)


def report(endpoints: dict[str, str] = PLACED, **fields: object) -> SessionStarted:
    """Return the report of a session that an earlier control has placed on these services."""
    start = replace(START, session="mine", epoch=4, endpoints=endpoints, **fields)
    return SessionStarted(session="mine", request="r", start=start)


def test_restores_a_session_unchanged(stage: Stage, client: Socket) -> None:
    recognizer, synthesizer = stage.services
    stage.receive(synthesizer)  # its heartbeat is answered
    stage.receive(recognizer)
    face = FaceSettings(lip_model="learned", expressiveness=1.5)
    recognizer.send(report(face=face))
    for service in stage.services:
        (start,) = stage.receive(service)
        assert isinstance(start, StartSession)
        assert (start.session, start.epoch, start.token) == ("mine", 4, "t")
        assert start.face == face
    client.send(CloseSession(session="mine", token="t", request="1"))
    assert stage.receive(client) == [Done(session="mine", request="1")]


def test_defers_a_request_until_its_session_is_restored(stage: Stage, client: Socket) -> None:
    client.send(CloseSession(session="mine", token="t", request="1"))
    while not stage.control._requests._deferred:
        stage.control.step(0.01)
    stage.services[0].send(report())
    assert stage.receive(client) == [Done(session="mine", request="1")]


@pytest.mark.parametrize("sender", ["synthesizer", "recognizer elsewhere"])
def test_only_the_recognizer_of_a_session_may_report_it(
    stage: Stage, client: Socket, sender: str
) -> None:
    recognizer, synthesizer = stage.services
    service = synthesizer if sender == "synthesizer" else recognizer
    stage.receive(service)
    service.send(report() if service is synthesizer else report(ELSEWHERE))
    service.send(beat(sender.partition(" ")[0]))
    stage.receive(service)  # the report was read before the heartbeat
    stage.control._takeover.end_s = 0.0
    client.send(CloseSession(session="mine", token="t", request="1"))
    (answer,) = stage.receive(client)
    assert isinstance(answer, Error)
    assert answer.code == "unknown-session"


def test_moves_a_session_without_synthesizer_at_the_deadline(stage: Stage) -> None:
    recognizer, synthesizer = stage.services
    recognizer.send(report({**PLACED, "faps": "tcp://127.0.0.1:3"}))
    stage.step_until(lambda: stage.control._takeover._reported)
    stage.control._takeover.end_s = 0.0
    starts: list[StartSession] = []
    while not starts or starts[-1].epoch == 4:
        told = stage.receive(synthesizer)
        starts += [message for message in told if isinstance(message, StartSession)]
    assert starts[-1].epoch == 5
    assert starts[-1].endpoints["faps"] == PLACED["faps"]


def test_stops_unknown_sessions_only_after_the_deadline(stage: Stage) -> None:
    recognizer, _ = stage.services
    stage.receive(recognizer)
    serving = beat("recognizer", sessions={"mine": SessionInput()})
    recognizer.send(serving)
    (seen,) = stage.receive(recognizer)
    assert not isinstance(seen, CloseSession)
    stage.control._takeover.end_s = 0.0
    while stage.control._takeover.is_active:
        stage.control.step(0.02)
    recognizer.send(serving)
    assert CloseSession(session="mine") in stage.receive(recognizer, 2)


def test_repeats_session_moved_to_the_client(
    stage: Stage, client: Socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifecycle, "REPEAT_AFTER_S", (0.1, 0.2))
    recognizer, synthesizer = stage.services
    client.send(OpenSession(session="mine", request="1"))
    for service in stage.services:
        _, start = stage.receive(service, 2)
        assert isinstance(start, StartSession)
        service.send(SessionStarted(session="mine", request=start.request))
    stage.receive(client)
    for media_time in (2840, 5000):  # a continuing recognizer repeats it
        speech = Speech(session="mine", epoch=1, sequence=1, media_time=media_time, active=True)
        recognizer.send(speech)
    recognizer.send(beat("recognizer"))
    stage.receive(recognizer)  # the synthesizer's, over another connection, might overtake speech
    synthesizer.send(beat("synthesizer", "tcp://127.0.0.1:9"))
    for service in reversed(stage.services):  # the recognizer last
        starts: list[StartSession] = []
        while not starts:
            told = stage.receive(service)
            starts = [message for message in told if isinstance(message, StartSession)]
        assert starts[0].speech_time == 2840
        service.send(SessionStarted(session="mine", request=starts[0].request))
    first, *others = stage.receive(client, 3)
    assert isinstance(first, SessionMoved)
    assert (first.epoch, first.faps) == (2, "tcp://127.0.0.1:9")
    assert others == [first, first]
