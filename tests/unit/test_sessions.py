"""Control's rules, without sockets."""

from __future__ import annotations

import dataclasses

import pytest

from kouxing.services.control.registry import UNPACED_AUDIO, Refusal, Registry
from kouxing.services.control.sessions import SessionRecord, Sessions
from kouxing.shared.keys import Peer
from kouxing.shared.wire.control import Heartbeat, SessionInput
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import OpenSession, SessionFacts

pytestmark = pytest.mark.unit

PEER = Peer(b"somebody")
PROVIDES = {"recognizer": ("audio", "phones"), "synthesizer": ("phone_input", "faps")}
FACTS = {
    "recognizer": SessionFacts(language="mandarin"),
    "synthesizer": SessionFacts(frame_rate_hz=50.0, delay_ms=100.0, lips="dynamic-visemes"),
}
NEEDS = {"recognizer": ["phone_input"], "synthesizer": []}


def worker(service: str, instance: str, state: str = "ready") -> Heartbeat:
    return Heartbeat(
        service=service,
        instance=instance,
        role="worker",
        state=state,
        sent_ns=0,
        endpoints={name: f"tcp://{instance}:{name}" for name in PROVIDES[service]},
        needs=NEEDS[service],
        facts=FACTS[service],
    )


def observer(instance: str) -> Heartbeat:
    return Heartbeat(
        service="lamp", instance=instance, role="observer", state="ready", sent_ns=0, needs=["faps"]
    )


class Made:
    """A registry with one recognizer and one synthesizer, and no sessions yet."""

    def __init__(self, max_sessions: int = 8, max_load: float = 1000.0) -> None:
        self.registry = Registry(lost_after_s=3.0, max_load=max_load)
        self.sessions = Sessions(self.registry, max_sessions)
        for service in PROVIDES:
            self.add(worker(service, f"{service}-1"))

    def add(self, heartbeat: Heartbeat, now_s: float = 0.0) -> None:
        self.registry.add(heartbeat, Peer(heartbeat.instance.encode()), now_s)

    def lose(self, instance: str) -> None:
        self.registry.remove(instance)
        self.sessions.lose(instance, 1.0)

    def open(self, name: str = "") -> SessionRecord:
        return self.sessions.open(OpenSession(session=name, request="r"), Peer(b"client"), 0.0)


@pytest.fixture
def made() -> Made:
    return Made()


def test_a_session_gets_a_name_a_token_and_its_services(made: Made) -> None:
    record = made.open()
    assert record.name
    assert len(record.token) >= 32
    assert record.waiting_for == {"recognizer-1", "synthesizer-1"}
    assert record.workers == {
        "audio": "recognizer-1",
        "phones": "recognizer-1",
        "phone_input": "synthesizer-1",
        "faps": "synthesizer-1",
    }


def test_the_services_are_told_the_delay_of_the_face_and_its_lips(
    made: Made,
) -> None:
    record = made.open()
    start = made.sessions.start_message(record, 0.0)
    assert (start.facts.delay_ms, start.face.lips) == (100.0, "dynamic-visemes")
    record.face.change(FaceSettings(lips="learnt"), 0.0)
    made.lose("synthesizer-1")
    facts = SessionFacts(delay_ms=40.0)
    made.add(dataclasses.replace(worker("synthesizer", "synthesizer-2"), facts=facts))
    assert made.sessions.replace(record, 1.0)
    start = made.sessions.start_message(record, 0.0)
    assert (start.facts.delay_ms, start.face.lips) == (40.0, "learnt")


def test_the_services_are_told_the_voice_of_the_speaker(made: Made) -> None:
    opening = OpenSession(request="r", mouth_profile=b"a profile")
    record = made.sessions.open(opening, Peer(b"client"), 0.0)
    assert made.sessions.start_message(record, 0.0).mouth_profile == b"a profile"


def test_what_was_chosen_for_the_face_is_told_to_those_that_take_it_over(made: Made) -> None:
    record = made.open()
    record.face.change(FaceSettings(expressions={"joy": 0.5}, hold_s=10.0), 0.0)
    record.face.change(FaceSettings(expressiveness=1.8, shapes=["vrm"]), 2.0)
    face = made.sessions.start_message(record, 4.0).face
    assert (face.expressiveness, face.expressions, face.hold_s) == (1.8, {"joy": 0.5}, 6.0)
    assert face.shapes == ["vrm"]
    assert made.sessions.start_message(record, 11.0).face.expressions is None


def test_the_services_know_the_client_for_a_control_that_starts_again(made: Made) -> None:
    client = Peer(b"client", "its key")
    record = made.sessions.open(OpenSession(request="r9"), client, 0.0)
    start = made.sessions.start_message(record, 0.0)
    assert (start.client, start.client_key, start.client_request) == (b"client", "its key", "r9")


def test_the_client_and_the_services_are_told_the_endpoints(made: Made) -> None:
    record = made.open()
    opened = made.sessions.opened_message(record, "tcp://control:events")
    assert opened.audio == "tcp://recognizer-1:audio"
    assert opened.phones == "tcp://recognizer-1:phones"
    assert opened.faps == "tcp://synthesizer-1:faps"
    assert (opened.facts.language, opened.facts.frame_rate_hz) == ("mandarin", 50.0)
    start = made.sessions.start_message(record, 0.0)
    assert start.endpoints["phone_input"] == "tcp://synthesizer-1:phone_input"
    assert start.facts == opened.facts


def test_names_and_tokens_differ(made: Made) -> None:
    records = [made.open() for _ in range(5)]
    assert len({record.name for record in records} | {record.token for record in records}) == 10


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_a_missing_service_is_named(made: Made, service: str) -> None:
    made.registry.remove(f"{service}-1")
    with pytest.raises(Refusal, match=f"no {service} is running") as caught:
        made.open()
    assert caught.value.code == "no-service"


def test_a_worker_of_an_unknown_kind_is_placed_where_another_needs_it(made: Made) -> None:
    gazing = dataclasses.replace(worker("synthesizer", "synthesizer-1"), needs=["gaze"])
    made.lose("synthesizer-1")
    made.add(gazing)
    with pytest.raises(Refusal, match="provides 'gaze'"):
        made.open()
    made.add(
        Heartbeat(
            service="eyes",
            instance="eyes-1",
            role="worker",
            state="ready",
            sent_ns=0,
            endpoints={"gaze": "tcp://eyes-1:gaze"},
        )
    )
    record = made.open()
    assert record.workers["gaze"] == "eyes-1"
    assert "eyes-1" in record.waiting_for
    assert made.sessions.start_message(record, 0.0).endpoints["gaze"] == "tcp://eyes-1:gaze"


def test_observers_of_any_kind_take_part(made: Made) -> None:
    made.add(observer("lamp-1"))
    record = made.open()
    assert record.waiting_for == {"recognizer-1", "synthesizer-1", "lamp-1"}
    made.add(observer("lamp-2"))
    assert made.sessions.participants(record) >= {"lamp-1", "lamp-2"}


def test_a_name_is_taken_once(made: Made) -> None:
    made.open("demo")
    with pytest.raises(Refusal) as caught:
        made.open("demo")
    assert caught.value.code == "session-exists"


def test_there_is_a_limit() -> None:
    made = Made(max_sessions=1)
    made.open()
    with pytest.raises(Refusal) as caught:
        made.open()
    assert caught.value.code == "too-many-sessions"


def test_no_service_is_lost_because_control_did_not_listen(made: Made) -> None:
    made.registry.excuse(10.0)
    assert made.registry.silent(12.9) == []
    assert len(made.registry.silent(13.1)) == 2


def test_one_key_does_not_take_all_sessions() -> None:
    made = Made(max_sessions=4)
    greedy, other = Peer(b"a", "greedy"), Peer(b"b", "other")
    for _ in range(3):
        made.sessions.open(OpenSession(request="r"), greedy, 0.0)
    with pytest.raises(Refusal, match="of your key") as caught:
        made.sessions.open(OpenSession(request="r"), greedy, 0.0)
    assert caught.value.code == "too-many-sessions"
    made.sessions.open(OpenSession(request="r"), other, 0.0)


def test_a_session_is_only_given_for_its_token(made: Made) -> None:
    record = made.open("demo")
    assert made.sessions.owned("demo", record.token) is record
    with pytest.raises(Refusal) as caught:
        made.sessions.owned("demo", "guess")
    assert caught.value.code == "bad-token"
    with pytest.raises(Refusal) as caught:
        made.sessions.owned("other", record.token)
    assert caught.value.code == "unknown-session"


def test_sessions_go_to_the_least_loaded(made: Made) -> None:
    made.add(worker("recognizer", "recognizer-2"))
    records = [made.open() for _ in range(4)]
    used = [record.workers["audio"] for record in records]
    assert sorted(used) == ["recognizer-1", "recognizer-1", "recognizer-2", "recognizer-2"]
    assert all(record.workers["audio"] == record.workers["phones"] for record in records)


def test_a_draining_service_gets_nothing_new(made: Made) -> None:
    made.add(worker("recognizer", "recognizer-2"))
    made.add(worker("recognizer", "recognizer-1", state="draining"))
    assert made.open().workers["audio"] == "recognizer-2"


def test_a_service_without_heartbeat_is_lost_after_the_limit(made: Made) -> None:
    made.add(worker("recognizer", "recognizer-1"), 2.5)
    assert made.registry.silent(2.9) == []
    assert made.registry.silent(3.1) == ["synthesizer-1"]


def take_input(made: Made, record: SessionRecord, sequence: int, idle_s: float = 0.0) -> float:
    """Take a heartbeat of the session's recognizer; return the idle time that counts."""
    beat = dataclasses.replace(
        worker("recognizer", record.workers["audio"]),
        sessions={record.name: SessionInput(idle_s=idle_s, sequence=sequence)},
    )
    return made.sessions.take_input(record, beat)


def test_audio_of_a_session_that_is_not_paced_has_a_socket_of_its_own(made: Made) -> None:
    for instance in ("recognizer-1", "recognizer-2"):
        made.lose("recognizer-1")
        own = {UNPACED_AUDIO: f"tcp://{instance}:unpaced"}
        heartbeat = worker("recognizer", instance)
        made.add(dataclasses.replace(heartbeat, endpoints={**heartbeat.endpoints, **own}))
        if instance == "recognizer-1":
            live = made.open("live")
            opening = OpenSession(session="file", request="r", paced=False)
            file = made.sessions.open(opening, PEER, 0.0)
            assert made.sessions.opened_message(live, "").audio == "tcp://recognizer-1:audio"
            assert made.sessions.opened_message(file, "").audio == "tcp://recognizer-1:unpaced"
    assert made.sessions.replace(file, 1.0)
    assert made.sessions.moved_message(file).audio == "tcp://recognizer-2:unpaced"
    start = made.sessions.start_message(file, 0.0)
    assert made.sessions.restore(start, 2.0).audio == "tcp://recognizer-2:unpaced"


def test_a_session_moves_to_another_recognizer_and_goes_on_where_the_lost_one_was(
    made: Made,
) -> None:
    record = made.open()
    take_input(made, record, sequence=120)
    made.lose("recognizer-1")
    assert record.lost == {"recognizer-1"}
    assert not made.sessions.replace(record, 1.0)
    assert made.sessions.state(record, 1.0).endpoints["audio"] == "tcp://recognizer-1:audio"
    made.add(worker("recognizer", "elsewhere"))
    assert made.sessions.replace(record, 1.0)
    assert (record.workers["audio"], record.workers["faps"]) == ("elsewhere", "synthesizer-1")
    moved = made.sessions.moved_message(record)
    assert (moved.epoch, moved.next_sequence) == (2, 121)
    assert (moved.audio, moved.faps) == ("tcp://elsewhere:audio", "tcp://synthesizer-1:faps")


def test_a_new_recognizer_that_has_no_audio_yet_does_not_set_the_session_back(made: Made) -> None:
    record = made.open()
    take_input(made, record, sequence=120)
    made.lose("recognizer-1")
    made.add(worker("recognizer", "elsewhere"))
    made.sessions.replace(record, 1.0)
    take_input(made, record, sequence=0)
    assert record.next_sequence == 121


def test_a_session_moves_to_no_recognizer_of_another_language(made: Made) -> None:
    record = made.open()
    made.lose("recognizer-1")
    made.add(
        dataclasses.replace(
            worker("recognizer", "elsewhere"), facts=SessionFacts(language="english")
        )
    )
    assert not made.sessions.replace(record, 1.0)


def test_audio_goes_on_where_it_was_when_only_the_synthesizer_is_lost(made: Made) -> None:
    record = made.open()
    take_input(made, record, sequence=120)
    made.lose("synthesizer-1")
    made.add(worker("synthesizer", "synthesizer-2"))
    assert made.sessions.replace(record, 1.0)
    moved = made.sessions.moved_message(record)
    assert (moved.epoch, moved.next_sequence) == (2, None)
    assert moved.faps == "tcp://synthesizer-2:faps"


def test_only_the_recognizer_knows_how_long_there_was_no_audio(made: Made) -> None:
    record = made.open()
    assert take_input(made, record, sequence=1, idle_s=70.0) == 70.0
    beat = dataclasses.replace(
        worker("synthesizer", "synthesizer-1"), sessions={record.name: SessionInput(idle_s=99.0)}
    )
    assert made.sessions.take_input(record, beat) == 0.0


def test_a_lost_worker_that_comes_back_keeps_its_sessions(made: Made) -> None:
    record = made.open()
    record.announced, record.waiting_for = True, set()
    made.lose("recognizer-1")
    assert not made.sessions.replace(record, 1.0), "there is no other"
    assert made.sessions.unsettled() == [record]
    assert "recognizer-1" not in made.sessions.participants(record)
    made.add(worker("recognizer", "recognizer-1"))
    assert made.registry.is_back("recognizer-1", Peer(b"recognizer-1"))
    assert made.sessions.take_back("recognizer-1") == []
    assert (record.epoch, made.sessions.unsettled()) == (1, [])
    assert "recognizer-1" in made.sessions.participants(record)


def test_a_lost_worker_is_told_again_what_it_may_have_missed(made: Made) -> None:
    record = made.open()
    made.lose("recognizer-1")
    record.waiting_for.clear()
    made.add(worker("recognizer", "recognizer-1"))
    assert made.sessions.take_back("recognizer-1") == [record]
    assert record.waiting_for == {"recognizer-1"}


def test_another_process_under_the_name_of_a_lost_one_is_not_the_same(made: Made) -> None:
    made.lose("recognizer-1")
    assert not made.registry.is_back("recognizer-1", Peer(b"another"))


def test_a_new_recognizer_is_told_after_the_synthesizer_up_to_where_there_are_phones(
    made: Made,
) -> None:
    record = made.open()
    made.lose("recognizer-1")
    made.add(worker("recognizer", "recognizer-2"))
    assert made.sessions.replace(record, 1.0)
    assert record.waiting_for - record.held_back == {"synthesizer-1"}
    assert made.sessions.take_started(record, "lamp-1", 0) == set()
    assert made.sessions.take_started(record, "synthesizer-1", 48_000) == {"recognizer-2"}
    assert made.sessions.start_message(record, 1.0).media_time == 48_000
    assert made.sessions.take_started(record, "recognizer-2", 0) == set()
    assert (record.waiting_for, record.media_time) == (set(), 48_000)


def test_a_recognizer_is_told_after_a_new_synthesizer_what_the_lost_one_last_said(
    made: Made,
) -> None:
    record = made.open()
    beat = dataclasses.replace(
        worker("synthesizer", "synthesizer-1"),
        sessions={record.name: SessionInput(media_time=32_000)},
    )
    made.sessions.take_input(record, beat)
    made.lose("recognizer-1")
    made.lose("synthesizer-1")
    made.add(worker("recognizer", "recognizer-2"))
    made.add(worker("synthesizer", "synthesizer-2"))
    assert made.sessions.replace(record, 1.0)
    assert record.waiting_for - record.held_back == {"synthesizer-2"}
    assert made.sessions.take_started(record, "synthesizer-2", 0) == {"recognizer-2"}
    assert made.sessions.start_message(record, 1.0).media_time == 32_000


def test_a_recognizer_that_stays_is_told_after_a_new_synthesizer(made: Made) -> None:
    record = made.open()
    made.lose("synthesizer-1")
    made.add(worker("synthesizer", "synthesizer-2"))
    assert made.sessions.replace(record, 1.0)
    assert record.waiting_for - record.held_back == {"synthesizer-2"}
    assert made.sessions.take_started(record, "synthesizer-2", 0) == {"recognizer-1"}


def test_services_are_silent_in_the_order_of_their_heartbeats(made: Made) -> None:
    made.add(worker("recognizer", "recognizer-1"), now_s=2.0)
    assert made.registry.silent(2.5) == []
    assert made.registry.silent(3.5) == ["synthesizer-1"]
    made.registry.excuse(1.0)
    assert made.registry.silent(3.5) == [], "control itself did not listen"
    assert made.registry.silent(6.5) == ["synthesizer-1", "recognizer-1"]


def test_a_worker_at_the_same_endpoints_displaces_the_one_that_crashed(made: Made) -> None:
    old = worker("recognizer", "recognizer-1")
    again = dataclasses.replace(old, instance="recognizer-9")
    assert made.registry.displaced_by(again, PEER) == "recognizer-1"
    assert not made.registry.displaced_by(old, PEER)
    made.add(again)
    made.lose("recognizer-1")
    assert not made.registry.displaced_by(again, PEER)


def test_observers_displace_no_other(made: Made) -> None:
    made.add(observer("lamp-1"))
    assert not made.registry.displaced_by(observer("lamp-2"), PEER)


def test_an_instance_that_provides_something_else_now_is_another_one(made: Made) -> None:
    same = worker("recognizer", "recognizer-1", state="draining")
    peer = Peer(b"recognizer-1")
    assert not made.registry.differs(same, peer)
    assert made.registry.differs(same, Peer(b"started again under its name"))
    moved = dataclasses.replace(same, endpoints={"audio": "tcp://new:1"})
    assert made.registry.differs(moved, peer)
    assert not made.registry.differs(worker("recognizer", "unknown"), peer)
