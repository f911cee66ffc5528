"""The rules by which control opens, moves, restores and ends sessions; no sockets, no clocks."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from kouxing_client.messages import SessionFacts, Speech

from kouxing.services.control.restart_recovery import RestartRecovery
from kouxing.shared.errors import Rejected
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import Peer
from kouxing.shared.wire.control import Heartbeat, SessionProgress
from kouxing.shared.wire.face import FaceSettings
from tests.control_cluster import CLIENT, Cluster, worker


def observer(instance: str) -> Heartbeat:
    return Heartbeat(
        service="lamp", instance=instance, role="observer", state="ready", sent_ns=0, needs=["faps"]
    )


@pytest.fixture
def cluster() -> Cluster:
    return Cluster()


@contextmanager
def refused(code: str, text: str | None = None) -> Iterator[None]:
    with pytest.raises(Rejected, match=text) as caught:
        yield
    assert caught.value.code == code


def test_a_client_may_choose_a_language_of_the_recognizer(cluster: Cluster) -> None:
    cluster.lose("recognizer-1")
    heartbeat = worker("recognizer", "recognizer-2")
    cluster.add(replace(heartbeat, languages=["universal", "german"]))
    assert cluster.open("a", language="de").facts.language == "german"
    record = cluster.open("b", language="auto")
    assert record.facts.language == record.start_message(0.0).facts.language == "universal"
    assert cluster.open("c", language="zh").facts.language == "mandarin"
    assert cluster.open("d").facts.language == "mandarin"
    with refused("bad-language", "no recognizer has the language french"):
        cluster.open("e", language="fr")
    with refused("bad-language", "'klingon' is not installed; choose from: auto, zh"):
        cluster.open("f", language="klingon")
    with refused("bad-face", "light has only mandarin"):
        cluster.open("g", language="de", face=FaceSettings(acoustic="light"))


def test_a_session_of_a_chosen_language_moves_only_to_a_worker_that_has_it(
    cluster: Cluster,
) -> None:
    languages = ["universal"]
    cluster.add(replace(worker("recognizer", "recognizer-2"), languages=languages))
    record = cluster.open("a", language="auto")
    assert "recognizer-2" in record.workers.values()
    cluster.lose("recognizer-2")
    assert not cluster.sessions.move(record, 1.0)  # recognizer-1 has only Mandarin
    cluster.add(replace(worker("recognizer", "recognizer-3"), languages=languages))
    assert cluster.sessions.move(record, 1.0)
    assert record.facts.language == "universal"


def test_control_collects_the_lip_models_of_all_synthesizers(cluster: Cluster) -> None:
    for instance, lip_models in (("one", ["learned"]), ("two", ["ferguson", "learned"])):
        cluster.add(replace(worker("synthesizer", instance), lip_models=lip_models))
    assert cluster.registry.lip_models() == []  # synthesizer-1, of an older version, sends none
    cluster.lose("synthesizer-1")
    assert cluster.registry.lip_models() == ["ferguson", "learned"]


def test_a_face_listens_to_a_session_that_already_speaks(cluster: Cluster) -> None:
    speaker = cluster.open("speaker")
    speaker.is_speaking = True
    face = FaceSettings(listen_to="speaker")
    listener = cluster.open("listener", face=face)
    assert listener.face.settings.listening
    assert cluster.open("other", face=FaceSettings(listen_to="")).face.settings.listening is False
    explicit = replace(face, listening=False)  # the client's own value
    assert cluster.sessions.with_listening(explicit) == explicit
    assert cluster.sessions.listeners_of("speaker") == [listener]
    cluster.sessions.change_face(listener, FaceSettings(listen_to="other"), 1.0)
    assert cluster.sessions.listeners_of("speaker") == []
    assert cluster.sessions.listeners_of("other") == [listener]
    cluster.sessions.remove(listener, 1.0)
    assert cluster.sessions.listeners_of("other") == []


def test_a_new_session_waits_for_its_workers_and_all_observers(cluster: Cluster) -> None:
    cluster.add(observer("lamp-1"))
    record = cluster.open()
    assert record.name
    assert len(record.token) >= 32
    assert set(record.workers.values()) == {"recognizer-1", "synthesizer-1"}
    assert record.waiting_for == {"recognizer-1", "synthesizer-1", "lamp-1"}
    cluster.add(observer("lamp-2"))
    assert cluster.sessions.participants(record) >= {"lamp-1", "lamp-2"}


def test_the_client_and_the_services_get_the_endpoints_and_facts(cluster: Cluster) -> None:
    record = cluster.open(mouth_profile=b"a profile")
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
def test_the_error_names_a_missing_service(cluster: Cluster, service: str) -> None:
    cluster.registry.remove(f"{service}-1")
    with refused("no-service", f"no {service} is running"):
        cluster.open()


def test_only_a_driver_can_write_a_video(cluster: Cluster) -> None:
    cluster.add(observer("gateway-1"))
    with refused("no-service", "no driver is running to write the video"):
        cluster.open("a", record=True)
    cluster.add(replace(observer("driver-1"), service="driver"))
    cluster.open("a", record=True)


def test_places_a_needed_worker_of_an_unknown_kind(cluster: Cluster) -> None:
    cluster.lose("synthesizer-1")
    cluster.add(replace(worker("synthesizer", "synthesizer-1"), needs=["gaze"]))
    with pytest.raises(Rejected, match="provides 'gaze'"):
        cluster.open()
    eyes = {"service": "eyes", "instance": "eyes-1", "endpoints": {"gaze": "tcp://eyes:1"}}
    cluster.add(replace(worker("synthesizer", "eyes-1"), **eyes, needs=[]))
    record = cluster.open()
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
    cluster: Cluster, endpoints: dict[str, str], code: str
) -> None:
    bad = replace(worker("synthesizer", "synthesizer-2"), endpoints=endpoints)
    with refused(code):
        cluster.registry.check(bad, CLIENT)


def test_refuses_names_that_are_taken_and_wrong_tokens(cluster: Cluster) -> None:
    record = cluster.open("demo")
    assert cluster.sessions.find_authorized("demo", record.token) is record
    with refused("session-exists"):
        cluster.open("demo")
    with refused("bad-token"):
        cluster.sessions.find_authorized("demo", "guess")
    with refused("unknown-session"):
        cluster.sessions.find_authorized("other", record.token)


def test_limits_the_sessions_in_total_and_per_key() -> None:
    cluster = Cluster(max_sessions=4)
    for _ in range(3):
        cluster.open(client=Peer(b"a", "greedy"))
    with refused("too-many-sessions", "your key has"):
        cluster.open(client=Peer(b"a", "greedy"))
    cluster.open()
    with refused("too-many-sessions", "max_sessions"):
        cluster.open()


def test_a_new_worker_gets_the_face_as_it_is_now(cluster: Cluster) -> None:
    record = cluster.open(face=FaceSettings(shapes=["vrm", "vrm"]))
    assert record.start_message(0.0).opening.face.lip_model == "dynamic-visemes", (
        "the synthesizer's default"
    )
    record.face.change(FaceSettings(expressions={"joy": 0.5}, hold_s=10.0), 0.0)
    record.face.change(FaceSettings(expressiveness=1.8, lip_model="learned", shapes=["arkit"]), 2.0)
    face = record.start_message(4.0).opening.face
    assert (face.lip_model, face.expressiveness, face.shapes) == ("learned", 1.8, ["vrm", "arkit"])
    assert (face.expressions, face.hold_s) == ({"joy": 0.5}, 6.0)
    assert record.start_message(11.0).opening.face.expressions is None
    cluster.lose("synthesizer-1")
    facts = SessionFacts(delay_ms=40.0, lip_model="ferguson")
    cluster.add(replace(worker("synthesizer", "synthesizer-2"), facts=facts))
    assert cluster.sessions.move(record, 12.0)
    start = record.start_message(12.0)
    assert (start.facts.delay_ms, start.opening.face.lip_model) == (40.0, "learned")


def test_a_session_moves_to_another_recognizer_and_resumes_where_it_was(cluster: Cluster) -> None:
    record = cluster.open()
    cluster.report(record, "recognizer-1", last_droppable_sequence=120)
    cluster.lose("recognizer-1")
    assert record.lost == {"recognizer-1"}
    assert not cluster.sessions.move(record, 1.0), "there is no other recognizer"
    assert record.state(1.0).endpoints["audio"] == "tcp://recognizer-1:audio"
    cluster.add(replace(worker("recognizer", "english"), facts=SessionFacts(language="english")))
    assert not cluster.sessions.move(record, 1.0), "it recognizes another language"
    cluster.add(worker("recognizer", "other"))
    assert cluster.sessions.move(record, 1.0)
    assert (record.workers["audio"], record.workers["faps"]) == ("other", "synthesizer-1")
    moved = record.moved_message()
    assert (moved.epoch, moved.next_sequence) == (2, 121)
    assert (moved.audio, moved.faps) == ("tcp://other:audio", "tcp://synthesizer-1:faps")
    heartbeat = replace(worker("recognizer", "other"), sessions={record.name: SessionProgress()})
    cluster.sessions.record_progress(record, heartbeat)
    assert record.next_sequence == 121, "the new recognizer has no audio yet"


def test_late_heartbeat_of_an_ended_session_does_not_affect_its_successor(cluster: Cluster) -> None:
    ended = cluster.open("demo")
    cluster.sessions.remove(ended, 0.0)
    record = cluster.open("demo")
    old = SessionProgress(last_droppable_sequence=900, final_until=48_000, idle_s=59.0)
    heartbeat = replace(worker("recognizer", "recognizer-1"), sessions={"demo": old})
    assert cluster.sessions.record_progress(record, heartbeat) == 0.0
    assert (record.next_sequence, record.final_until) == (1, 0)


@pytest.mark.parametrize(
    ("lost", "reported", "last"),
    [
        (("recognizer-1",), 48_000, "recognizer-2"),
        (("recognizer-1", "synthesizer-1"), 0, "recognizer-2"),
        (("synthesizer-1",), 0, "recognizer-1"),
    ],
)
def test_recognizer_starts_last_and_receives_final_until(
    cluster: Cluster, lost: tuple[str, ...], reported: int, last: str
) -> None:
    record = cluster.open()
    cluster.report(record, "synthesizer-1", final_until=32_000)
    for instance in lost:
        cluster.lose(instance)
        cluster.add(worker(instance.partition("-")[0], instance.replace("1", "2")))
    assert cluster.sessions.move(record, 1.0)
    assert (record.moved_message().next_sequence is None) == ("recognizer-1" not in lost)
    synthesizer = record.workers["faps"]
    assert record.waiting_for - record.deferred == {synthesizer}
    assert cluster.sessions.record_started(record, "lamp-1", 0) == set()
    assert cluster.sessions.record_started(record, synthesizer, reported) == {last}
    assert record.start_message(1.0).final_until == max(32_000, reported)
    assert cluster.sessions.record_started(record, last, 0) == set()


def test_does_not_start_a_recognizer_that_is_lost(cluster: Cluster) -> None:
    record = cluster.open()
    cluster.lose("synthesizer-1")
    cluster.add(worker("synthesizer", "synthesizer-2"))
    assert cluster.sessions.move(record, 1.0)
    cluster.lose("recognizer-1")
    assert cluster.sessions.record_started(record, "synthesizer-2", 0) == set()
    assert record.waiting_for == set()


def test_services_become_silent_in_the_order_of_their_heartbeats(cluster: Cluster) -> None:
    cluster.add(worker("recognizer", "recognizer-1"), now_s=2.0)
    assert cluster.registry.overdue_services(2.9) == []
    assert cluster.registry.overdue_services(3.5) == ["synthesizer-1"]
    cluster.registry.exclude_pause(1.0, 3.5)
    assert cluster.registry.overdue_services(3.5) == [], "control did not run"
    assert cluster.registry.overdue_services(6.5) == ["synthesizer-1", "recognizer-1"]


def test_a_heartbeat_that_arrives_after_a_pause_of_control_is_not_from_the_future(
    cluster: Cluster,
) -> None:
    cluster.add(worker("recognizer", "recognizer-1"), now_s=60.0)  # handled before the tick
    cluster.registry.exclude_pause(58.0, 60.0)
    assert cluster.registry.age_s("recognizer-1", 60.0) == 0.0
    assert "recognizer-1" in cluster.registry.overdue_services(63.5)


def test_waits_longer_for_heartbeats_after_a_service_was_late(cluster: Cluster) -> None:
    cluster.registry.adapt_timeout(after_s=60.0, now_s=0.0)
    assert len(cluster.registry.overdue_services(3.5)) == 2
    cluster.registry.adapt_timeout(after_s=1.0, now_s=3.5)
    assert cluster.registry.overdue_services(4.9) == []
    assert len(cluster.registry.overdue_services(5.1)) == 2
    cluster.registry.adapt_timeout(after_s=1.0, now_s=6.0)
    cluster.add(worker("recognizer", "recognizer-1"), now_s=66.0)
    assert cluster.registry.overdue_services(66.1) == ["synthesizer-1"]
    assert len(cluster.registry.overdue_services(69.1)) == 2, "the usual limit applies again"


def test_ignores_what_arrives_from_a_connection_that_has_ended(cluster: Cluster) -> None:
    heartbeat, peer = worker("recognizer", "recognizer-1"), Peer(b"recognizer-1", connection=7)
    cluster.registry.add(heartbeat, peer, 0.0)
    cluster.registry.add(heartbeat, dataclasses.replace(peer, connection=0), 0.0)
    assert cluster.registry.instance_by_connection(7) == "recognizer-1"
    cluster.lose("recognizer-1")
    assert cluster.registry.is_stale("recognizer-1", dataclasses.replace(peer, connection=0))
    assert not cluster.registry.is_stale("recognizer-1", dataclasses.replace(peer, connection=8))


def test_distinguishes_a_restarted_worker_from_the_crashed_one(cluster: Cluster) -> None:
    old, peer = worker("recognizer", "recognizer-1"), Peer(b"recognizer-1")
    new = replace(old, instance="recognizer-9")
    assert cluster.registry.find_replaced_worker(new, CLIENT) is None, (
        "its endpoints have another key"
    )
    assert cluster.registry.find_replaced_worker(new, peer) == "recognizer-1"
    assert cluster.registry.find_replaced_worker(old, peer) is None
    assert not cluster.registry.is_other_process(old, peer)
    assert cluster.registry.is_other_process(old, Peer(b"restarted"))
    assert cluster.registry.is_other_process(replace(old, endpoints={"audio": "tcp://new:1"}), peer)
    cluster.lose("recognizer-1")
    assert not cluster.registry.reclaim_lost("recognizer-1", Peer(b"restarted")), (
        "it is not the same"
    )


def test_a_heartbeat_without_sessions_may_be_older(cluster: Cluster) -> None:
    cluster.add(replace(worker("synthesizer", "synthesizer-1"), sessions={}))
    assert cluster.registry.next_overdue_s() == pytest.approx(3.0)
    cluster.add(worker("recognizer", "recognizer-1"), 1.0)
    assert cluster.registry.next_overdue_s() == pytest.approx(3.75)
    assert cluster.registry.overdue_services(3.7) == []
    assert cluster.registry.overdue_services(3.8) == ["synthesizer-1"]


def test_a_session_that_returns_to_a_recognizer_starts_a_new_epoch_there(cluster: Cluster) -> None:
    record = cluster.open("demo")
    cluster.lose("synthesizer-1")
    cluster.add(worker("synthesizer", "synthesizer-2"))
    assert cluster.sessions.move(record, 1.0)
    assert (record.epoch, record.recognizer_epoch) == (2, 1)
    for lost, other in (("1", "2"), ("2", "1")):
        cluster.lose(f"recognizer-{lost}")
        cluster.add(worker("recognizer", f"recognizer-{other}"))
        assert cluster.sessions.move(record, 1.0)
    assert (record.epoch, record.recognizer_epoch) == (4, 4)


def test_restores_a_session_from_its_newest_recognizer(cluster: Cluster) -> None:
    record = cluster.open("demo")
    stalled = record.start_message(0.0)
    cluster.lose("recognizer-1")
    cluster.add(worker("recognizer", "recognizer-2"))
    assert cluster.sessions.move(record, 1.0)
    cluster.add(worker("recognizer", "recognizer-1"))
    recovery = RestartRecovery(cluster.registry, 2.0)
    assert recovery.add_reported_session(record.start_message(2.0), "recognizer-2")
    recovery.add_reported_session(stalled, "recognizer-1")
    (start,) = recovery.pop_complete()
    assert start.epoch == 2


@pytest.mark.parametrize("has_stopped", [False, True])
def test_a_restored_session_still_speaks(cluster: Cluster, has_stopped: bool) -> None:
    record = cluster.open("demo")
    record.is_speaking, record.speech_time = True, 2840
    recovery = RestartRecovery(cluster.registry, 2.0)
    assert recovery.add_reported_session(record.start_message(2.0), "recognizer-1")
    stop = Speech(session="demo", epoch=1, media_time=5000, active=False)
    recovery.record_speech(stop, "recognizer-1" if has_stopped else "synthesizer-1")
    (start,) = recovery.pop_complete()
    cluster.sessions.remove(record, 2.0)
    restored = cluster.sessions.restore(start, 2.0)
    assert restored.start_message(3.0).speech_time == (None if has_stopped else 2840)
    assert cluster.sessions.num_speaking("recognizer-1") == (0 if has_stopped else 1)
