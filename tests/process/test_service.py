"""The loop that every service runs."""

import errno
import math
import socket
import time
from collections.abc import Callable, Iterator

import pytest
from kouxing_client.messages import Speech

from kouxing.services.control.config import ControlConfig
from kouxing.services.control.service import ControlService
from kouxing.shared.bus import Bus
from kouxing.shared.config import ServiceConfig
from kouxing.shared.fast_record import replace
from kouxing.shared.keys import Peer, key_folder, revoke_key
from kouxing.shared.service import (
    EXIT_AFTER_S,
    HEARTBEAT_S,
    MAX_LATE_S,
    RESYNC_AFTER_S,
    SESSIONS_PER_HEARTBEAT,
    Service,
)
from kouxing.shared.service_kind import ServiceKind
from kouxing.shared.session_service import SessionService
from kouxing.shared.sockets import Socket
from kouxing.shared.wire.control import Heartbeat, SessionProgress, SessionStarted
from kouxing.shared.wire.speech import Progress
from tests.fake_control import FakeControl
from tests.raw_bytes import answer_handshake
from tests.samples import START
from tests.system import LIMIT_S, wait_until


class SlowService(Service):
    """Takes 5 ms for a message; counts ticks, heartbeats and messages."""

    kind = ServiceKind(name="slow", role="worker")

    def __init__(self) -> None:
        super().__init__(ServiceConfig(insecure=True), has_control=False)
        self.num_ticks = self.num_beats = self.num_handled = 0
        self.tick_due_s = math.inf
        self.input = self.bus.bind_router("tcp://127.0.0.1:*", "slow.input")
        self.register(self.input, {Progress: self._on_progress})

    def on_tick(self, now_s: float) -> float:
        self.num_ticks += 1
        return self.tick_due_s

    def deliver_heartbeat(self, heartbeat: Heartbeat) -> None:
        self.num_beats += 1

    def _on_progress(self, _progress: Progress, _sender: Peer) -> None:
        self.num_handled += 1
        time.sleep(0.005)


class ServiceWithKey(Service):
    kind = ServiceKind(name="keyed", role="worker")


@pytest.fixture
def slow() -> Iterator[SlowService]:
    service = SlowService()
    yield service
    service.bus.close()


def handle(service: SlowService, num_messages: int) -> None:
    wait_until(lambda: service.num_handled >= num_messages, step=lambda: service.step(0.01))


def test_a_flood_of_messages_does_not_stop_ticks_and_heartbeats(slow: SlowService) -> None:
    with Bus() as bus:
        sender = bus.connect_dealer(slow.input.endpoint)
        for _ in range(300):
            sender.send(Progress(level_db=0.0))
        handle(slow, 300)
    assert slow.num_ticks > 10, "1.5 s of work"
    assert slow.num_beats >= 2


def test_sleeps_until_a_tick_or_heartbeat_is_due_or_a_message_arrives(slow: SlowService) -> None:
    waits: list[float] = []

    def wait(timeout_s: float) -> list[Socket]:
        waits.append(timeout_s)
        return []

    slow.wait = wait  # type: ignore[method-assign]
    slow.step(60.0)
    assert waits == [0.0], "the first tick and heartbeat are due"
    slow._heartbeat_due_s = time.monotonic() + 30.0
    slow.step(60.0)
    assert 20.0 < waits[-1] <= 30.0
    assert slow.num_ticks == 1, "nothing is due"
    slow._last_tick_s, slow.tick_due_s = 0.0, time.monotonic() + 20.0
    slow.waker.wake()
    slow.step(60.0)
    slow.step(60.0)
    assert slow.num_ticks == 2
    assert 10.0 < waits[-1] <= 20.0


def test_answers_counts_and_drops_unexpected_messages(slow: SlowService) -> None:
    with Bus() as bus:
        sender = bus.connect_dealer(slow.input.endpoint)
        sender.send(Speech(session="s", active=True))
        sender.send(Progress(level_db=0.0))
        handle(slow, 1)
        assert sender.wait(LIMIT_S)
        (answer,) = [received.message for received in sender.receive()]
    assert getattr(answer, "code", "") == "bad-message"
    assert slow.metrics.snapshot(0.0)["dropped_unexpected"] == 1


def test_drops_a_message_when_no_file_can_be_opened(slow: SlowService) -> None:
    handle_progress = slow._on_progress

    def open_nothing(progress: Progress, sender: Peer) -> None:
        handle_progress(progress, sender)
        if slow.num_handled == 1:
            raise OSError(errno.EMFILE, "Too many open files")

    slow._handlers[slow.input][Progress] = open_nothing
    with Bus() as bus:
        sender = bus.connect_dealer(slow.input.endpoint)
        for _ in range(2):
            sender.send(Progress(session="s", level_db=0.0))
        handle(slow, 2)


@pytest.mark.parametrize(("address", "warns"), [("10.0.0.1", True), ("127.0.0.1", False)])
def test_warns_if_an_insecure_service_is_reachable_from_other_hosts(
    slow: SlowService, caplog: pytest.LogCaptureFixture, address: str, warns: bool
) -> None:
    slow.endpoints = {"input": f"tcp://{address}:5570"}
    slow.startup()
    assert ("insecure = true" in caplog.text) == warns


class Worker(SessionService):
    """Records what happens, in order."""

    kind = ServiceKind(name="worker", role="worker")

    def __init__(self, control: str, num_sessions: int = 1) -> None:
        super().__init__(ServiceConfig(insecure=True, control=control))
        self.input = self.bus.bind_router("tcp://127.0.0.1:*", "worker.input")
        self.endpoints = {"audio": self.input.endpoint}
        self.happened: list[str] = []
        self.names = [f"s{number}" for number in range(num_sessions)]
        self.register(self.input, {Progress: lambda *_: self.happened.append("input")})

    def stop_session(self, session: str) -> None:
        self.happened.append(f"stop {session}")

    def session_progress(self) -> dict[str, SessionProgress]:
        return dict.fromkeys(self.names, SessionProgress())


@pytest.fixture
def worker(control: FakeControl) -> Iterator[Worker]:
    new_worker = Worker(control.address)
    yield new_worker
    new_worker.bus.close()


def run_until(worker: Worker, condition: Callable[[], object]) -> None:
    wait_until(condition, step=lambda: worker.step(0.01))


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a service wait longer for control on a busy machine."""
    monkeypatch.setattr("kouxing.shared.service.REPLY_TIMEOUT_S", LIMIT_S)


@pytest.mark.usefixtures("patient")
def test_resyncs_with_control_after_a_stall(control: FakeControl, worker: Worker) -> None:
    run_until(worker, lambda: control.heartbeats)
    with Bus() as bus:
        sender = bus.connect_dealer(worker.input.endpoint)
        sender.send(Progress(level_db=0.0))
        time.sleep(HEARTBEAT_S + RESYNC_AFTER_S + 0.1)
        control.stops = ["s0"]
        run_until(worker, lambda: "input" in worker.happened)
    assert worker.happened[:2] == ["stop s0", "input"]


@pytest.mark.usefixtures("patient")
def test_resyncs_after_a_stall_in_a_handler_before_it_ticks(
    control: FakeControl, worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_until(worker, lambda: control.heartbeats)

    def stall(*_: object) -> None:
        control.stops = ["s0"]
        time.sleep(HEARTBEAT_S + RESYNC_AFTER_S + 0.1)
        worker.happened.append("input")

    def on_tick(_now_s: float) -> float:
        worker.happened.append("tick")
        return math.inf

    worker._handlers[worker.input][Progress] = stall
    monkeypatch.setattr(worker, "on_tick", on_tick)
    with Bus() as bus:
        bus.connect_dealer(worker.input.endpoint).send(Progress(level_db=0.0))
        run_until(worker, lambda: "input" in worker.happened)
    after = worker.happened.index("input")
    assert worker.happened[after : after + 3] == ["input", "stop s0", "tick"]


def test_a_restarted_control_learns_the_sessions(
    monkeypatch: pytest.MonkeyPatch, control: FakeControl, worker: Worker
) -> None:
    start = replace(START, session="s0", epoch=3)
    monkeypatch.setattr(worker, "served_sessions", lambda: [start])
    run_until(worker, lambda: control.heartbeats)
    assert not control.messages_of(SessionStarted)
    control.name = "control-2"
    run_until(worker, lambda: control.messages_of(SessionStarted))
    assert [started.start for started in control.messages_of(SessionStarted)] == [start]


@pytest.mark.parametrize(
    ("curve", "rest"), [(True, b""), (False, b"\x00\x05hello")], ids=["other keys", "no ZeroMQ"]
)
def test_registers_at_an_address_where_another_program_answered_before(
    monkeypatch: pytest.MonkeyPatch, curve: bool, rest: bytes
) -> None:
    monkeypatch.setattr("kouxing.shared.service.NO_REPLY_S", 0.3)
    monkeypatch.setattr(Service, "_warn_about_control", lambda self: None)
    listener = socket.create_server(("127.0.0.1", 0))
    commands = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    worker = Worker(commands)
    worker.endpoints = {"input": worker.input.endpoint}
    answer_handshake(listener, curve, rest)
    config = ControlConfig(control=commands, events="tcp://127.0.0.1:*", insecure=True)
    control = ControlService(config)

    def step() -> None:
        worker.step(0.01)
        control.step(0.01)

    wait_until(lambda: worker.instance in control._registry, step=step)
    for service in (worker, control):
        service.bus.close()


@pytest.mark.usefixtures("new_keys")
def test_starts_again_when_a_rejected_key_was_replaced() -> None:
    local = "tcp://127.0.0.1:*"
    control = ControlService(ControlConfig(control=local, events=local))
    address, _, _ = control.endpoints["commands"].partition(" ")
    service = ServiceWithKey(ServiceConfig(control=address))
    revoke_key("keyed")
    service._warn_about_control()
    assert not service.should_exit
    (key_folder() / "keyed.key").unlink()
    service._warn_about_control()
    assert service.should_exit
    assert service.has_new_key
    for one in (service, control):
        one.bus.close()


def test_reports_draining_before_it_finishes_its_sessions(control: FakeControl) -> None:
    worker = Worker(control.address, num_sessions=2 * SESSIONS_PER_HEARTBEAT)
    run_until(worker, lambda: control.heartbeats)

    def draining() -> list[Heartbeat]:
        return [beat for beat in [*control.heartbeats] if beat.state == "draining"]

    def finish() -> bool:
        wait_until(draining)
        return True

    worker.on_drain = finish  # type: ignore[method-assign]
    worker.shutdown()
    assert {*draining()[0].sessions} == {*worker.names}


def test_heartbeats_report_many_sessions_in_turn(control: FakeControl) -> None:
    worker = Worker(control.address, num_sessions=2 * SESSIONS_PER_HEARTBEAT + 10)
    try:
        run_until(worker, lambda: len(control.heartbeats) >= 3)
    finally:
        worker.bus.close()
    named = [name for beat in control.heartbeats[:3] for name in beat.sessions]
    assert len(named) == 3 * SESSIONS_PER_HEARTBEAT
    assert {*named} == {*worker.names}


def test_a_health_check_ends_a_process_whose_loop_hangs(
    slow: SlowService, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends: list[int] = []
    monkeypatch.setattr("kouxing.shared.service.os._exit", ends.append)
    slow.step(0.0)
    assert slow.check_health()
    slow._heartbeat_due_s -= MAX_LATE_S + 1.0
    assert not slow.check_health()
    assert ends == []
    slow._heartbeat_due_s -= EXIT_AFTER_S
    slow.check_health()
    assert ends == [1]
