"""The loop that every service runs."""

import errno
import math
import socket
from collections.abc import Callable, Iterator

import pytest
import zmq
from kouxing_client.keys import Key, read_key

from kouxing.services.control.config import ControlConfig
from kouxing.services.control.service import ControlService
from kouxing.shared.clock import now_ns
from kouxing.shared.fast_record import replace
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.sockets import Socket
from kouxing.shared.service.base import (
    EXIT_AFTER_S,
    HEARTBEAT_S,
    IDLE_HEARTBEAT_S,
    MAX_LATE_S,
    NO_REPLY_S,
    RESYNC_AFTER_S,
    SESSIONS_PER_HEARTBEAT,
    TICK_S,
    Service,
)
from kouxing.shared.service.service_kind import ServiceKind
from kouxing.shared.service.session_service import SessionService
from kouxing.shared.settings.config import ServiceConfig
from kouxing.shared.settings.keys import format_key, key_folder, revoke_key
from kouxing.shared.wire.control import Heartbeat, SessionProgress, SessionStarted
from kouxing.shared.wire.session import Error, FlushSession
from kouxing.shared.wire.speech import Progress
from tests.fake_control import FakeControl
from tests.raw_bytes import answer_handshake
from tests.samples import START
from tests.system import LIMIT_S, free_port, wait_until

STALL_S = HEARTBEAT_S + RESYNC_AFTER_S + 0.1


class Clock:
    """Replaces the module ``time`` in the loop of a service; a test lets the time pass."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def process_time(self) -> float:
        return 0.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    new_clock = Clock()
    for module in ("base", "message_loop"):
        monkeypatch.setattr(f"kouxing.shared.service.{module}.time", new_clock)
    return new_clock


class SlowService(Service):
    """Takes 5 ms for a message; counts ticks, heartbeats and messages."""

    kind = ServiceKind(name="slow", role="worker")
    connects_to_control = False

    def __init__(self, clock: Clock) -> None:
        super().__init__(ServiceConfig(insecure=True))
        self.clock = clock
        self.num_ticks = self.num_beats = self.num_handled = 0
        self.tick_due_s = math.inf
        self.input = self.bus.bind_router("tcp://127.0.0.1:*", "slow.input")
        self.register(self.input, {Progress: lambda *_: self.on_progress()})

    def on_tick(self, now_s: float) -> float:
        self.num_ticks += 1
        return self.tick_due_s

    def deliver_heartbeat(self, heartbeat: Heartbeat) -> None:
        self.num_beats += 1

    def on_progress(self) -> None:
        self.num_handled += 1
        self.clock.now_s += 0.005


class ServiceWithKey(Service):
    kind = ServiceKind(name="keyed", role="worker")


@pytest.mark.parametrize(("control", "warns"), [("10.0.0.1", True), ("127.0.0.1", False)])
def test_warns_if_only_this_host_can_connect_but_control_is_for_others(
    control: str, warns: bool, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ServiceWithKey, "connects_to_control", False)
    config = ServiceConfig(control=f"tcp://{control}:5550", insecure=True)
    service = ServiceWithKey(config)
    service.endpoints = {"audio": "tcp://127.0.0.1:5560", "phones": "tcp://10.0.0.2:5561"}
    service.startup()
    service.bus.close()
    assert ("cannot connect to audio at tcp://127.0.0.1:5560" in caplog.text) is warns
    assert "connect to phones" not in caplog.text


@pytest.fixture
def slow(clock: Clock) -> Iterator[SlowService]:
    service = SlowService(clock)
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


def test_sleeps_until_a_tick_or_heartbeat_is_due_or_a_message_arrives(
    slow: SlowService, clock: Clock
) -> None:
    waits: list[float] = []

    def wait(timeout_s: float) -> list[Socket]:
        waits.append(timeout_s)
        return []

    slow.wait = wait  # type: ignore[method-assign]
    slow.step(60.0)
    assert waits == [0.0], "the first tick and heartbeat are due"
    slow.step(60.0)
    assert waits[-1] == IDLE_HEARTBEAT_S
    assert slow.num_ticks == 1, "nothing is due"
    clock.now_s += TICK_S
    slow.tick_due_s = clock.now_s + 0.5
    slow.waker.wake()
    slow.step(60.0)
    assert slow.num_ticks == 2
    slow.step(60.0)
    assert waits[-1] == pytest.approx(0.5)


def test_answers_counts_and_drops_unexpected_messages(slow: SlowService) -> None:
    with Bus() as bus:
        sender = bus.connect_dealer(slow.input.endpoint)
        sender.send(FlushSession(session="s", request="r", token="t"))
        sender.send(Progress(level_db=0.0))
        handle(slow, 1)
        assert sender.wait(LIMIT_S)
        (answer,) = [received.message for received in sender.receive()]
    assert isinstance(answer, Error)
    assert (answer.code, answer.request) == ("bad-message", "r")
    assert slow.metrics.snapshot(0.0)["dropped_unexpected"] == 1


def test_a_paused_socket_keeps_its_place_and_its_settings(
    slow: SlowService, monkeypatch: pytest.MonkeyPatch
) -> None:
    later, quiet = (slow.bus.bind_router("tcp://127.0.0.1:*", name) for name in ("later", "quiet"))
    slow.register(later, {})
    slow.register(quiet, {}, is_quiet=True)
    bound = [slow.input, later, quiet]
    with Bus() as bus:
        for socket in bound:
            bus.connect_dealer(socket.endpoint).send(Progress(level_db=0.0))
        wait_until(lambda: slow.wait(0.01) == bound)
        for paused in (True, True, False, False):  # `pause` is also called without a change
            slow.pause(slow.input, paused=paused)
            slow.pause(quiet, paused=paused)
            assert slow.wait(0.0) == ([later] if paused else bound)
        polled: list[zmq.Socket[bytes]] = []
        poll = zmq.Poller.poll

        def record(poller: zmq.Poller, timeout_ms: int) -> list[tuple[zmq.Socket[bytes], int]]:
            events = poll(poller, timeout_ms)
            polled.extend(raw for raw, _event in events)
            return events

        monkeypatch.setattr(zmq.Poller, "poll", record)
        slow.wait(0.0)
        assert slow.input.raw in polled
        assert quiet.raw not in polled, "a quiet socket does not wake the loop"


def test_a_paused_socket_can_be_closed(slow: SlowService) -> None:
    slow.pause(slow.input, paused=True)
    slow.unregister(slow.input)
    assert slow.wait(0.0) == []


def test_drops_a_message_when_no_file_can_be_opened(
    slow: SlowService, monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_nothing() -> None:
        slow.num_handled += 1
        if slow.num_handled == 1:
            raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(slow, "on_progress", open_nothing)
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
        self.register(self.input, {Progress: lambda *_: self.on_progress()})

    def on_progress(self) -> None:
        self.happened.append("input")

    def stop_session(self, session: str) -> None:
        self.happened.append(f"stop {session}")

    def session_progress(self) -> dict[str, SessionProgress]:
        return dict.fromkeys(self.names, SessionProgress())


@pytest.fixture
def worker(control: FakeControl, clock: Clock) -> Iterator[Worker]:
    new_worker = Worker(control.address)
    yield new_worker
    new_worker.bus.close()


def run_until(worker: Worker, condition: Callable[[], object]) -> None:
    wait_until(condition, step=lambda: worker.step(0.01))


@pytest.mark.parametrize("step_ns", [0, -(10**10)])
def test_resyncs_with_control_after_a_stall(
    control: FakeControl,
    worker: Worker,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
    step_ns: int,
) -> None:
    run_until(worker, lambda: worker._control_instance)
    # While a machine is suspended, its wall clock may be set back.
    monkeypatch.setattr("kouxing.shared.service.base.now_ns", lambda: now_ns() + step_ns)
    with Bus() as bus:
        bus.connect_dealer(worker.input.endpoint).send(Progress(level_db=0.0))
        assert worker.input.wait(LIMIT_S)
        clock.now_s += STALL_S
        control.stops = ["s0"]
        run_until(worker, lambda: "input" in worker.happened)
    assert worker.happened[:2] == ["stop s0", "input"]


def test_resyncs_after_a_stall_in_a_handler_before_it_ticks(
    control: FakeControl, worker: Worker, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_until(worker, lambda: control.heartbeats)

    def stall() -> None:
        control.stops = ["s0"]
        clock.now_s += STALL_S
        worker.happened.append("input")

    def on_tick(_now_s: float) -> float:
        worker.happened.append("tick")
        return math.inf

    monkeypatch.setattr(worker, "on_progress", stall)
    monkeypatch.setattr(worker, "on_tick", on_tick)
    with Bus() as bus:
        bus.connect_dealer(worker.input.endpoint).send(Progress(level_db=0.0))
        run_until(worker, lambda: "tick" in worker.happened)
    after = worker.happened.index("input")
    assert worker.happened[after : after + 3] == ["input", "stop s0", "tick"]


def test_a_restarted_control_receives_the_sessions(
    monkeypatch: pytest.MonkeyPatch, control: FakeControl, worker: Worker, clock: Clock
) -> None:
    start = replace(START, session="s0", epoch=3)
    monkeypatch.setattr(worker, "served_sessions", lambda: [start])
    run_until(worker, lambda: control.heartbeats)
    assert not control.messages_of(SessionStarted)
    control.name = "control-2"
    clock.now_s += HEARTBEAT_S
    run_until(worker, lambda: control.messages_of(SessionStarted))
    assert [started.start for started in control.messages_of(SessionStarted)] == [start]


@pytest.mark.parametrize(
    ("curve", "rest"), [(True, b""), (False, b"\x00\x05hello")], ids=["other keys", "no ZeroMQ"]
)
def test_registers_at_an_address_where_another_program_answered_before(
    monkeypatch: pytest.MonkeyPatch, curve: bool, rest: bytes
) -> None:
    for limit in ("NO_REPLY_S", "FIRST_REPLY_S"):
        monkeypatch.setattr(f"kouxing.shared.service.base.{limit}", 0.3)
    monkeypatch.setattr(
        "kouxing.shared.service.base.explain_unreachable", lambda *_, **__: "not asked"
    )
    port = free_port()
    listener = socket.create_server(("127.0.0.1", port))
    commands = f"tcp://127.0.0.1:{port}"
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
def test_starts_again_when_a_rejected_key_was_replaced(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    local = "tcp://127.0.0.1:*"
    control = ControlService(ControlConfig(control=local, events=local))
    address, _, _ = control.endpoints["commands"].partition(" ")
    service = ServiceWithKey(ServiceConfig(control=address))

    def step() -> None:
        clock.now_s += 0.02 * NO_REPLY_S
        service.step(0.01)

    revoke_key("keyed")
    wait_until(lambda: "does not accept" in caplog.text, step=step)
    path = key_folder() / "keyed.key"
    key = read_key(path)
    path.write_text(format_key(Key(key.public, key.secret, key.public)), "utf-8")
    wait_until(lambda: "belongs to a different system than" in caplog.text, step=step)
    assert not service.should_exit
    path.unlink()
    wait_until(lambda: service.should_exit, step=step)
    assert service.has_new_key
    for process in (service, control):
        process.bus.close()


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
    slow: SlowService, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends: list[int] = []
    monkeypatch.setattr("kouxing.shared.service.base.os._exit", ends.append)
    slow.step(0.0)
    assert slow.check_or_exit()
    clock.now_s += IDLE_HEARTBEAT_S + MAX_LATE_S
    assert not slow.check_or_exit()
    assert ends == []
    clock.now_s += EXIT_AFTER_S
    slow.check_or_exit()
    assert ends == [1]
