"""Placement and admission by load, without sockets and clocks."""

from __future__ import annotations

import dataclasses

import pytest

from kouxing.services.control.load import MEASURED_S, NUM_SURE, RETRY_AFTER_S, WorkerLoad
from kouxing.services.control.registry import Refusal
from kouxing.shared.keys import Peer
from kouxing.shared.wire.session import OpenSession
from tests.unit.test_sessions import Made, worker

pytestmark = pytest.mark.unit

MAX_LOAD = 0.8
WORKERS = ("recognizer-1", "recognizer-2", "synthesizer-1", "synthesizer-2")


def loaded(
    num_sessions: int, load: float, *, now_s: float = 10.0, paced: bool = True
) -> WorkerLoad:
    """Return a worker whose sessions were placed long ago, after a heartbeat."""
    made = WorkerLoad()
    for _ in range(num_sessions):
        made.place(0.0, paced=paced)
    made.measure(load, now_s)
    return made


def num_admitted(load: WorkerLoad, now_s: float) -> int:
    """Place sessions at one moment until there is no room; return how many there was for."""
    before = load.num_sessions
    while load.has_room(now_s, MAX_LOAD):
        load.place(now_s, paced=True)
    return load.num_sessions - before


def test_a_worker_that_served_none_yet_takes_a_few_at_once_and_more_once_measured() -> None:
    load = WorkerLoad()
    assert num_admitted(load, 0.0) == 3
    load.measure(0.15, 3.0)  # 0.05 each
    assert num_admitted(load, 3.0) == 13


@pytest.mark.parametrize(
    ("num_sessions", "measured", "admitted"),
    [(2, 0.19, 6), (6, 0.57, 2), (8, 0.76, 0), (8, 1.0, 0), (1, 0.01, 79)],
)
def test_the_room_is_what_measured_load_and_measured_cost_leave(
    num_sessions: int, measured: float, admitted: int
) -> None:
    assert num_admitted(loaded(num_sessions, measured), 10.0) == admitted


def test_the_load_without_sessions_is_no_cost_of_theirs() -> None:
    load = WorkerLoad()
    load.measure(0.05, 1.0)
    load.place(2.0, paced=True)
    load.measure(0.15, 10.0)
    assert load.cost == pytest.approx(0.1)


def test_who_is_silent_now_may_speak_in_a_moment() -> None:
    load = loaded(4, 0.4)
    load.measure(0.02, 12.0)
    assert load.expected(12.0) == pytest.approx(0.4, rel=0.05), "the largest cost is remembered"
    load.measure(0.02, 1000.0)
    assert load.expected(1000.0) < 0.05, "but not for ever"


def test_sessions_that_have_just_ended_are_in_the_measured_load_still() -> None:
    load = loaded(8, 0.8)
    for _ in range(7):
        load.leave(10.0, paced=True)
    load.measure(0.75, 10.2)
    assert load.expected(10.2) == pytest.approx(0.1, rel=0.05)
    assert load.cost == pytest.approx(0.1, rel=0.05), (
        "not those of all eight at the one that is left"
    )


def test_sound_faster_than_real_time_takes_whatever_is_free_and_shuts_nobody_out() -> None:
    load = loaded(2, 0.1)
    load.place(20.0, paced=False)
    load.measure(1.0, 30.0)
    assert load.has_room(30.0, MAX_LOAD)
    load.leave(30.0, paced=False)
    load.measure(0.9, 30.5)
    assert load.has_room(30.5, MAX_LOAD), "the load is that of the last two seconds"
    load.measure(0.1, 30.5 + MEASURED_S)
    assert load.expected(30.5 + MEASURED_S) == pytest.approx(0.1)


@pytest.fixture
def made() -> Made:
    made = Made(max_sessions=100, max_load=MAX_LOAD)
    made.add(worker("recognizer", "recognizer-2"))
    made.add(worker("synthesizer", "synthesizer-2"))
    return made


def beat(made: Made, instance: str, load: float, now_s: float) -> None:
    service = instance.partition("-")[0]
    made.add(dataclasses.replace(worker(service, instance), load=load), now_s)


def open_at(made: Made, now_s: float, *, paced: bool = True) -> str:
    """Open a session; return its recognizer."""
    record = made.sessions.open(OpenSession(request="r", paced=paced), Peer(b"client"), now_s)
    return record.workers["audio"]


def test_a_session_goes_to_the_least_loaded_worker_not_to_that_with_fewest_sessions(
    made: Made,
) -> None:
    assert [open_at(made, 0.0) for _ in range(3)].count("recognizer-1") == 2
    beat(made, "recognizer-1", 0.2, 5.0)
    beat(made, "recognizer-2", 0.5, 5.0)
    assert open_at(made, 5.0) == "recognizer-1"


def test_what_was_placed_since_counts_before_it_is_measured(made: Made) -> None:
    placed = [open_at(made, 0.0) for _ in range(6)]
    assert placed.count("recognizer-1") == placed.count("recognizer-2") == 3


def test_one_more_than_there_is_room_for_is_refused_with_a_time(made: Made) -> None:
    for _ in range(4):
        open_at(made, 0.0)
    for instance in ("recognizer-1", "recognizer-2"):
        beat(made, instance, 0.75, 5.0)
    for instance in ("synthesizer-1", "synthesizer-2"):
        beat(made, instance, 0.1, 5.0)
    with pytest.raises(Refusal, match="every recognizer has as many sessions") as caught:
        open_at(made, 5.0)
    assert (caught.value.code, caught.value.retry_after_s) == ("busy", RETRY_AFTER_S)
    beat(made, "recognizer-2", 0.2, 6.0)
    with pytest.raises(Refusal):
        open_at(made, 6.0)  # its two sessions may speak again
    beat(made, "recognizer-2", 0.2, 300.0)
    assert open_at(made, 300.0) == "recognizer-2"


def test_an_idle_worker_may_have_no_load_at_all() -> None:
    load = WorkerLoad()
    load.measure(0.0, 0.0)
    load.measure(0.3, 1.0)
    load.place(1.0, paced=True)
    load.measure(0.3, 5.0)
    assert load.cost == pytest.approx(0.3)


def test_a_busy_synthesizer_is_a_reason_too(made: Made) -> None:
    made.lose("synthesizer-2")
    for _ in range(NUM_SURE):
        open_at(made, 0.0)
    beat(made, "synthesizer-1", 0.9, 5.0)
    with pytest.raises(Refusal, match="every synthesizer"):
        open_at(made, 5.0)


def test_the_first_sessions_are_served_however_busy_the_machine_is(made: Made) -> None:
    for _ in range(NUM_SURE):
        for instance in WORKERS:
            beat(made, instance, 1.0, 5.0)
        assert open_at(made, 5.0)


def test_sound_faster_than_real_time_takes_what_is_free_and_is_not_refused(made: Made) -> None:
    for _ in range(4):
        open_at(made, 0.0)
    for instance in WORKERS:
        beat(made, instance, 1.0, 5.0)
    with pytest.raises(Refusal):
        open_at(made, 5.0)
    assert open_at(made, 5.0, paced=False)


def test_a_session_that_moves_is_never_refused(made: Made) -> None:
    record = made.open()
    for instance in WORKERS:
        beat(made, instance, 1.0, 5.0)
    lost = record.workers["audio"]
    made.lose(lost)
    made.lose("synthesizer-1")
    assert made.sessions.replace(record, 5.0)
    assert record.workers["audio"] != lost
