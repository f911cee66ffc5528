"""The rules by which control opens, moves, restores and ends sessions; no sockets, no clocks."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from kouxing.services.control.placement import Placement
from kouxing.services.control.service_registry import ServiceRegistry
from kouxing.services.control.session_record import SessionRecord
from kouxing.services.control.session_table import SessionTable
from kouxing.shared.errors import Rejected
from kouxing.shared.fast_record import replace
from kouxing.shared.keys import Peer
from kouxing.shared.wire.control import Heartbeat, SessionProgress
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import OpenSession, SessionFacts

CLIENT = Peer(b"client", "its key")
PROVIDES = {"recognizer": ("audio", "phones"), "synthesizer": ("phone_input", "faps")}
NEEDS = {"recognizer": ["phone_input"], "synthesizer": []}
FACTS = {
    "recognizer": SessionFacts(language="mandarin"),
    "synthesizer": SessionFacts(frame_rate_hz=50.0, delay_ms=100.0, lip_model="dynamic-visemes"),
}


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
        sessions={"mine": SessionProgress()},
    )


def observer(instance: str) -> Heartbeat:
    return Heartbeat(
        service="lamp", instance=instance, role="observer", state="ready", sent_ns=0, needs=["faps"]
    )


class System:
    """The state of a control with one recognizer and one synthesizer."""

    def __init__(self, max_sessions: int = 8, max_load: float = 1000.0) -> None:
        self.registry = ServiceRegistry(lost_after_s=3.0)
        self.placement = Placement(self.registry, max_load)
        self.sessions = SessionTable(self.registry, self.placement, max_sessions)
        for service in PROVIDES:
            self.add(worker(service, f"{service}-1"))

    def add(self, heartbeat: Heartbeat, now_s: float = 0.0) -> None:
        self.registry.add(heartbeat, Peer(heartbeat.instance.encode()), now_s)

    def lose(self, instance: str) -> None:
        self.registry.remove(instance)
        self.sessions.mark_worker_lost(instance, 1.0)

    def open(self, name: str = "", client: Peer = CLIENT, **fields: object) -> SessionRecord:
        opening = OpenSession(session=name, request="r", **fields)  # type: ignore[arg-type]
        return self.sessions.open(opening, client, 0.0)

    def report(self, record: SessionRecord, instance: str, **fields: Any) -> None:
        """Record a heartbeat about a session."""
        heartbeat = worker(instance.partition("-")[0], instance)
        sessions = {record.name: SessionProgress(**fields)}
        self.sessions.record_progress(record, replace(heartbeat, sessions=sessions))


@pytest.fixture
def system() -> System:
    return System()


@contextmanager
def refused(code: str, text: str | None = None) -> Iterator[None]:
    with pytest.raises(Rejected, match=text) as caught:
        yield
    assert caught.value.code == code


def test_a_client_may_choose_a_language_of_the_recognizer(system: System) -> None:
    system.lose("recognizer-1")
    heartbeat = worker("recognizer", "recognizer-2")
    system.add(replace(heartbeat, languages=["universal", "german"]))
    assert system.open("a", language="de").facts.language == "german"
    record = system.open("b", language="auto")
    assert record.facts.language == record.start_message(0.0).facts.language == "universal"
    assert system.open("c", language="zh").facts.language == "mandarin"
    assert system.open("d").facts.language == "mandarin"
    with refused("bad-language", "no recognizer has the language french"):
        system.open("e", language="fr")
    with refused("bad-language", "'klingon' is not installed; choose from: auto, zh"):
        system.open("f", language="klingon")


def test_a_session_of_a_chosen_language_moves_only_to_a_worker_that_has_it(
    system: System,
) -> None:
    languages = ["universal"]
    system.add(replace(worker("recognizer", "recognizer-2"), languages=languages))
    record = system.open("a", language="auto")
    assert "recognizer-2" in record.workers.values()
    system.lose("recognizer-2")
    assert not system.sessions.move(record, 1.0)  # recognizer-1 has only Mandarin
    system.add(replace(worker("recognizer", "recognizer-3"), languages=languages))
    assert system.sessions.move(record, 1.0)
    assert record.facts.language == "universal"


def test_a_new_session_waits_for_its_workers_and_all_observers(system: System) -> None:
    system.add(observer("lamp-1"))
    record = system.open()
    assert record.name
    assert len(record.token) >= 32
    assert set(record.workers.values()) == {"recognizer-1", "synthesizer-1"}
    assert record.waiting_for == {"recognizer-1", "synthesizer-1", "lamp-1"}
    system.add(observer("lamp-2"))
    assert system.sessions.participants(record) >= {"lamp-1", "lamp-2"}


def test_the_client_and_the_services_get_the_endpoints_and_facts(system: System) -> None:
    record = system.open(mouth_profile=b"a profile")
    opened = record.opened_message("tcp://control:events")
    assert opened.audio == "tcp://recognizer-1:audio"
    assert opened.phones == "tcp://recognizer-1:phones"
    assert opened.faps == "tcp://synthesizer-1:faps"
    assert (opened.facts.language, opened.facts.frame_rate_hz) == ("mandarin", 50.0)
    start = record.start_message(0.0)
    assert start.endpoints["phone_input"] == "tcp://synthesizer-1:phone_input"
    assert start.facts == opened.facts
    assert start.opening.mouth_profile == b"a profile"
    assert (start.client, start.client_key, start.opening.request) == (b"client", "its key", "r")


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_the_error_names_a_missing_service(system: System, service: str) -> None:
    system.registry.remove(f"{service}-1")
    with refused("no-service", f"no {service} is running"):
        system.open()


def test_places_a_needed_worker_of_an_unknown_kind(system: System) -> None:
    system.lose("synthesizer-1")
    system.add(replace(worker("synthesizer", "synthesizer-1"), needs=["gaze"]))
    with pytest.raises(Rejected, match="provides 'gaze'"):
        system.open()
    eyes = {"service": "eyes", "instance": "eyes-1", "endpoints": {"gaze": "tcp://eyes:1"}}
    system.add(replace(worker("synthesizer", "eyes-1"), **eyes, needs=[]))
    record = system.open()
    assert record.workers["gaze"] == "eyes-1"
    assert "eyes-1" in record.waiting_for
    assert record.start_message(0.0).endpoints["gaze"] == "tcp://eyes:1"


@pytest.mark.parametrize(
    ("endpoints", "code"),
    [
        ({}, "bad-message"),
        ({"audio": "tcp://here:1"}, "not-allowed"),
        ({"faps": "nowhere"}, "bad-message"),
        ({"faps": "tcp://*:1"}, "bad-message"),
    ],
)
def test_refuses_a_worker_with_bad_endpoints(
    system: System, endpoints: dict[str, str], code: str
) -> None:
    bad = replace(worker("synthesizer", "synthesizer-2"), endpoints=endpoints)
    with refused(code):
        system.registry.check(bad, CLIENT)


def test_refuses_names_that_are_taken_and_wrong_tokens(system: System) -> None:
    record = system.open("demo")
    assert system.sessions.find_authorized("demo", record.token) is record
    with refused("session-exists"):
        system.open("demo")
    with refused("bad-token"):
        system.sessions.find_authorized("demo", "guess")
    with refused("unknown-session"):
        system.sessions.find_authorized("other", record.token)


def test_limits_the_sessions_in_total_and_per_key() -> None:
    system = System(max_sessions=4)
    for _ in range(3):
        system.open(client=Peer(b"a", "greedy"))
    with refused("too-many-sessions", "your key has"):
        system.open(client=Peer(b"a", "greedy"))
    system.open()
    with refused("too-many-sessions", "max_sessions"):
        system.open()


def test_a_new_worker_gets_the_face_as_it_is_now(system: System) -> None:
    record = system.open(face=FaceSettings(shapes=["vrm", "vrm"]))
    assert record.start_message(0.0).opening.face.lip_model == "dynamic-visemes", (
        "the synthesizer's default"
    )
    record.face.change(FaceSettings(expressions={"joy": 0.5}, hold_s=10.0), 0.0)
    record.face.change(FaceSettings(expressiveness=1.8, lip_model="learned", shapes=["arkit"]), 2.0)
    face = record.start_message(4.0).opening.face
    assert (face.lip_model, face.expressiveness, face.shapes) == ("learned", 1.8, ["vrm", "arkit"])
    assert (face.expressions, face.hold_s) == ({"joy": 0.5}, 6.0)
    assert record.start_message(11.0).opening.face.expressions is None
    system.lose("synthesizer-1")
    facts = SessionFacts(delay_ms=40.0, lip_model="ferguson")
    system.add(replace(worker("synthesizer", "synthesizer-2"), facts=facts))
    assert system.sessions.move(record, 12.0)
    start = record.start_message(12.0)
    assert (start.facts.delay_ms, start.opening.face.lip_model) == (40.0, "learned")


def test_a_session_moves_to_another_recognizer_and_resumes_where_it_was(system: System) -> None:
    record = system.open()
    system.report(record, "recognizer-1", last_droppable_sequence=120)
    system.lose("recognizer-1")
    assert record.lost == {"recognizer-1"}
    assert not system.sessions.move(record, 1.0), "there is no other recognizer"
    assert record.state(1.0).endpoints["audio"] == "tcp://recognizer-1:audio"
    system.add(replace(worker("recognizer", "english"), facts=SessionFacts(language="english")))
    assert not system.sessions.move(record, 1.0), "it recognizes another language"
    system.add(worker("recognizer", "other"))
    assert system.sessions.move(record, 1.0)
    assert (record.workers["audio"], record.workers["faps"]) == ("other", "synthesizer-1")
    moved = record.moved_message()
    assert (moved.epoch, moved.next_sequence) == (2, 121)
    assert (moved.audio, moved.faps) == ("tcp://other:audio", "tcp://synthesizer-1:faps")
    heartbeat = replace(worker("recognizer", "other"), sessions={record.name: SessionProgress()})
    system.sessions.record_progress(record, heartbeat)
    assert record.next_sequence == 121, "the new recognizer has no audio yet"


@pytest.mark.parametrize(
    ("lost", "reported", "last"),
    [
        (("recognizer-1",), 48_000, "recognizer-2"),
        (("recognizer-1", "synthesizer-1"), 0, "recognizer-2"),
        (("synthesizer-1",), 0, "recognizer-1"),
    ],
)
def test_the_recognizer_starts_last_and_learns_up_to_where_phones_are_final(
    system: System, lost: tuple[str, ...], reported: int, last: str
) -> None:
    record = system.open()
    system.report(record, "synthesizer-1", final_until=32_000)
    for instance in lost:
        system.lose(instance)
        system.add(worker(instance.partition("-")[0], instance.replace("1", "2")))
    assert system.sessions.move(record, 1.0)
    assert (record.moved_message().next_sequence is None) == ("recognizer-1" not in lost)
    synthesizer = record.workers["faps"]
    assert record.waiting_for - record.deferred == {synthesizer}
    assert system.sessions.record_started(record, "lamp-1", 0) == set()
    assert system.sessions.record_started(record, synthesizer, reported) == {last}
    assert record.start_message(1.0).final_until == max(32_000, reported)
    assert system.sessions.record_started(record, last, 0) == set()


def test_does_not_start_a_recognizer_that_is_lost(system: System) -> None:
    record = system.open()
    system.lose("synthesizer-1")
    system.add(worker("synthesizer", "synthesizer-2"))
    assert system.sessions.move(record, 1.0)
    system.lose("recognizer-1")
    assert system.sessions.record_started(record, "synthesizer-2", 0) == set()
    assert record.waiting_for == set()


def test_services_become_silent_in_the_order_of_their_heartbeats(system: System) -> None:
    system.add(worker("recognizer", "recognizer-1"), now_s=2.0)
    assert system.registry.overdue_services(2.9) == []
    assert system.registry.overdue_services(3.5) == ["synthesizer-1"]
    system.registry.exclude_pause(1.0)
    assert system.registry.overdue_services(3.5) == [], "control did not run"
    assert system.registry.overdue_services(6.5) == ["synthesizer-1", "recognizer-1"]


def test_waits_longer_for_heartbeats_after_a_service_was_late(system: System) -> None:
    system.registry.adapt_timeout(after_s=60.0, now_s=0.0)
    assert len(system.registry.overdue_services(3.5)) == 2
    system.registry.adapt_timeout(after_s=1.0, now_s=3.5)
    assert system.registry.overdue_services(4.9) == []
    assert len(system.registry.overdue_services(5.1)) == 2
    system.registry.adapt_timeout(after_s=1.0, now_s=6.0)
    system.add(worker("recognizer", "recognizer-1"), now_s=66.0)
    assert system.registry.overdue_services(66.1) == ["synthesizer-1"]
    assert len(system.registry.overdue_services(69.1)) == 2, "the usual limit applies again"


def test_ignores_what_arrives_from_a_connection_that_has_ended(system: System) -> None:
    heartbeat, peer = worker("recognizer", "recognizer-1"), Peer(b"recognizer-1", connection=7)
    system.registry.add(heartbeat, peer, 0.0)
    system.registry.add(heartbeat, dataclasses.replace(peer, connection=0), 0.0)
    assert system.registry.instance_by_connection(7) == "recognizer-1"
    system.lose("recognizer-1")
    assert system.registry.is_stale("recognizer-1", dataclasses.replace(peer, connection=0))
    assert not system.registry.is_stale("recognizer-1", dataclasses.replace(peer, connection=8))


def test_distinguishes_a_restarted_worker_from_the_crashed_one(system: System) -> None:
    old, peer = worker("recognizer", "recognizer-1"), Peer(b"recognizer-1")
    new = replace(old, instance="recognizer-9")
    assert system.registry.find_replaced_worker(new, CLIENT) is None, (
        "its endpoints have another key"
    )
    assert system.registry.find_replaced_worker(new, peer) == "recognizer-1"
    assert system.registry.find_replaced_worker(old, peer) is None
    assert not system.registry.is_other_process(old, peer)
    assert system.registry.is_other_process(old, Peer(b"restarted"))
    assert system.registry.is_other_process(replace(old, endpoints={"audio": "tcp://new:1"}), peer)
    system.lose("recognizer-1")
    assert not system.registry.reclaim_lost("recognizer-1", Peer(b"restarted")), (
        "it is not the same"
    )


def test_a_heartbeat_without_sessions_may_be_older(system: System) -> None:
    system.add(replace(worker("synthesizer", "synthesizer-1"), sessions={}))
    assert system.registry.next_overdue_s() == pytest.approx(3.0)
    system.add(worker("recognizer", "recognizer-1"), 1.0)
    assert system.registry.next_overdue_s() == pytest.approx(3.75)
    assert system.registry.overdue_services(3.7) == []
    assert system.registry.overdue_services(3.8) == ["synthesizer-1"]
