"""Placement by load: where sessions go, and when they are rejected; no sockets, no clocks."""

import pytest

from kouxing.services.control.worker_load import MIN_SESSIONS, RETRY_AFTER_S, WorkerLoad
from kouxing.shared.errors import Rejected
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import Peer
from kouxing.shared.wire.session import OpenSession
from tests.control_cluster import Cluster, worker

MAX_LOAD = 0.8
WORKERS = ("recognizer-1", "recognizer-2", "synthesizer-1", "synthesizer-2")


def loaded(num_sessions: int, load: float) -> WorkerLoad:
    """Return the load of a worker at 10 s; its sessions were placed long ago."""
    worker_load = WorkerLoad()
    for _ in range(num_sessions):
        worker_load.add_session(0.0, paced=True)
    worker_load.measure(load, 10.0)
    return worker_load


def num_admitted(load: WorkerLoad, now_s: float) -> int:
    """Place sessions until there is no room; return their number."""
    before = load.num_sessions
    while load.has_room(1, now_s, MAX_LOAD):
        load.add_session(now_s, paced=True)
    return load.num_sessions - before


@pytest.mark.parametrize(
    ("num_sessions", "measured", "admitted"), [(2, 0.19, 6), (8, 0.76, 0), (1, 0.01, 79)]
)
def test_admits_as_many_sessions_as_the_measured_load_leaves_room_for(
    num_sessions: int, measured: float, admitted: int
) -> None:
    assert num_admitted(WorkerLoad(), 0.0) == 8, "its cost is unknown"
    assert num_admitted(loaded(num_sessions, measured), 10.0) == admitted


def test_many_speaking_sessions_show_that_each_costs_less() -> None:
    load = loaded(1, 0.2)
    for _ in range(7):
        load.add_session(10.0, paced=True)
    for second in range(11, 31):
        load.measure(0.4, float(second), num_speaking=1)  # the others may cost more when they speak
    assert load.cost > 0.15
    for second in range(31, 51):
        load.measure(0.4, float(second), num_speaking=6)
    assert load.cost == pytest.approx(0.4 / 8, abs=0.02)
    assert num_admitted(load, 50.0) >= 5


def test_silent_sessions_do_not_hide_what_they_cost_when_they_speak() -> None:
    load = loaded(1, 0.2)
    for _ in range(7):
        load.add_session(10.0, paced=True)
    for second in range(11, 71):
        load.measure(0.4, float(second), num_speaking=8)
    for second in range(71, 3600):
        load.measure(0.04, float(second), num_speaking=0)
    assert load.cost == pytest.approx(0.4 / 8, abs=0.01)
    assert num_admitted(load, 3600.0) == 8


@pytest.fixture
def cluster() -> Cluster:
    cluster = Cluster(max_sessions=100, max_load=MAX_LOAD)
    cluster.add(worker("recognizer", "recognizer-2"))
    cluster.add(worker("synthesizer", "synthesizer-2"))
    return cluster


def measure(cluster: Cluster, instance: str, load: float, now_s: float) -> None:
    service = instance.partition("-")[0]
    cluster.add(replace(worker(service, instance), load=load), now_s)


def open_at(cluster: Cluster, now_s: float, *, paced: bool = True) -> str:
    """Open a session; return its recognizer."""
    record = cluster.sessions.open(OpenSession(request="r", paced=paced), Peer(b"client"), now_s)
    return record.workers["audio"]


def test_prefers_the_worker_with_the_least_load(cluster: Cluster) -> None:
    placed = [open_at(cluster, 0.0) for _ in range(6)]
    assert placed.count("recognizer-1") == placed.count("recognizer-2") == 3, "not measured yet"
    for instance in WORKERS:
        measure(cluster, instance, 0.3 if instance == "recognizer-2" else 0.2, 5.0)
    assert open_at(cluster, 5.0) == "recognizer-1"
    cluster.add(worker("recognizer", "recognizer-1", state="draining"))
    assert open_at(cluster, 5.0) == "recognizer-2"


def test_rejects_a_session_without_room_and_says_when_to_try_again(cluster: Cluster) -> None:
    for _ in range(4):
        open_at(cluster, 0.0)
    for instance in WORKERS:
        measure(cluster, instance, 0.75 if "recognizer" in instance else 0.1, 5.0)
    text = "every recognizer is busy: a session needs 38 % of one, but at most 5 % is free"
    with pytest.raises(Rejected, match=text) as caught:
        open_at(cluster, 5.0)
    assert (caught.value.code, caught.value.retry_after_s) == ("busy", RETRY_AFTER_S)
    measure(cluster, "recognizer-2", 0.2, 6.0)
    with pytest.raises(Rejected):
        open_at(cluster, 6.0)  # its two sessions may speak again
    measure(cluster, "recognizer-2", 0.2, 300.0)
    assert open_at(cluster, 300.0) == "recognizer-2"


def test_unpaced_sessions_of_one_key_leave_room_for_another_client(cluster: Cluster) -> None:
    opening, greedy = OpenSession(request="r", paced=False), Peer(b"a", "greedy")
    for _ in range(14):  # seven of the eight for which each recognizer has room
        cluster.sessions.open(opening, greedy, 0.0)
    with pytest.raises(Rejected, match=r"needs 20 % of one, but at most 10 % is free"):
        cluster.sessions.open(opening, greedy, 0.0)
    assert cluster.sessions.open(opening, Peer(b"b", "other"), 0.0)


def test_never_rejects_the_first_sessions_or_a_session_that_moves(cluster: Cluster) -> None:
    for _ in range(2 * MIN_SESSIONS):
        for instance in WORKERS:
            measure(cluster, instance, 1.0, 5.0)
        assert open_at(cluster, 5.0)
    for paced in (True, False):
        with pytest.raises(Rejected):
            open_at(cluster, 5.0, paced=paced)
    record = next(iter(cluster.sessions))
    cluster.lose(record.workers["audio"])
    cluster.lose(record.workers["faps"])
    assert cluster.sessions.move(record, 5.0)


def test_control_reports_which_kinds_of_worker_are_missing() -> None:
    cluster = Cluster()
    assert cluster.placement.missing_kinds() == []
    cluster.add(worker("synthesizer", "synthesizer-1", "draining"))
    assert cluster.placement.missing_kinds() == ["synthesizer"]
    cluster.lose("recognizer-1")
    assert cluster.placement.missing_kinds() == ["recognizer", "synthesizer"]
    cluster.add(worker("synthesizer", "synthesizer-2"))
    assert cluster.placement.missing_kinds() == ["recognizer"]
