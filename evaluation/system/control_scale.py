"""What many workers and sessions cost one control: CPU, memory, and the delay of an open.

Control is a real process. This one plays the workers: each has its own connection, sends its
heartbeats and starts what it is told, and nothing else.
"""

from __future__ import annotations

import os
import resource
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from kouxing.services.kinds import free_addresses
from kouxing.shared.bus import Bus, Socket
from kouxing.shared.clock import now_ns
from kouxing.shared.connections import raise_file_limit
from kouxing.shared.errors import UserError
from kouxing.shared.keys import control_endpoint, own_key, user_key
from kouxing.shared.service import HEARTBEAT_S, SESSIONS_A_BEAT
from kouxing.shared.wire.codec import BadMessage
from kouxing.shared.wire.control import (
    Heartbeat,
    HeartbeatSeen,
    SessionInput,
    StartSession,
    StopSession,
)
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import CloseSession, Done, Error, OpenSession, SessionOpened

PROVIDED = {"recognizer": ("audio", "phones"), "synthesizer": ("phone_input", "faps")}
SETTLE_S, MEASURE_S = 5.0, 20.0
NUM_TIMED = 50  # sessions whose opening is timed
MAX_OPENING = 64  # requests under way while the others are opened
RETRY_S = 0.25  # after a request was refused
NUM_CLIENTS = 8  # connections that these come through: each may send 500 a second
SOCKETS_OF_BUS = 250
FILES_OF_WORKER = 4  # at most
LOAD = 0.5  # of a worker with its share of the sessions
TURN_S = 0.002  # between looks at what has arrived


@dataclass(frozen=True, slots=True)
class Cost:
    """What control costs with a number of workers and sessions."""

    num_workers: int
    num_sessions: int
    heartbeats_per_s: float  # that were answered
    cpu_share: float  # of one core
    memory_mb: float
    open_ms_p50: float
    open_ms_p95: float
    num_lost: int  # workers that were taken for lost


class _Worker:
    """One worker as control sees it."""

    def __init__(self, kind: str, number: int, socket: Socket, due_s: float) -> None:
        self.kind = kind
        self.instance = f"{kind}-{number}"
        self.socket = socket
        self.due_s = due_s
        self.names: dict[str, None] = {}
        self.num_answered = 0
        self._turn = 0

    def beat(self, share: int) -> None:
        """Send a heartbeat with some of the sessions; a fair share of them makes the full load."""
        names = list(self.names)
        begin = self._turn % max(1, len(names))
        self._turn = begin + SESSIONS_A_BEAT
        port = 1 + int(self.instance.partition("-")[2])
        self.socket.send(
            Heartbeat(
                service=self.kind,
                instance=self.instance,
                role="worker",
                state="ready",
                sent_ns=now_ns(),
                endpoints=dict.fromkeys(PROVIDED[self.kind], f"tcp://127.0.0.1:{port}"),
                needs=["phone_input"] if self.kind == "recognizer" else [],
                language="mandarin" if self.kind == "recognizer" else "",
                load=min(1.0, LOAD * len(names) / share),
                metrics={f"figure_{number}": 1.0 for number in range(20)},
                sessions=dict.fromkeys(names[begin : self._turn], SessionInput(sequence=1)),
            )
        )

    def take(self) -> None:
        """Start and stop what control says."""
        for received in self.socket.receive():
            match received.message:
                case StartSession() as start:
                    self.names[start.session] = None
                    self.socket.send(Done(session=start.session, request=start.request))
                case StopSession() as stop:
                    self.names.pop(stop.session, None)
                case HeartbeatSeen():
                    self.num_answered += 1


class _Cluster:
    """All workers, and clients that open sessions at control."""

    def __init__(self, stack: ExitStack, control: str, num_workers: int, num_sessions: int) -> None:
        keys = {kind: own_key(kind, (f"service:{kind}",)) for kind in PROVIDED}
        self._share = -(-2 * (num_sessions + NUM_TIMED) // num_workers)  # of each worker
        self.workers: list[_Worker] = []
        for kind in PROVIDED:
            for number in range(num_workers // 2):
                if number % SOCKETS_OF_BUS == 0:
                    bus = stack.enter_context(Bus(keys[kind]))
                due_s = time.monotonic() + HEARTBEAT_S * number / (num_workers // 2)
                self.workers.append(_Worker(kind, number, bus.connect_dealer(control), due_s))
        bus = stack.enter_context(Bus(user_key()))
        self._clients = [bus.connect_dealer(control) for _ in range(NUM_CLIENTS)]
        self._opening: dict[str, float] = {}
        self.delays_s: list[float] = []  # of the sessions that are open
        self._opened: list[tuple[Socket, SessionOpened]] = []
        self._refused_s = 0.0

    def run(self, duration_s: float) -> None:
        """Let the workers work."""
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            self._turn()

    def open(self, number: int, at_once: int) -> None:
        """Open sessions, some of them at once."""
        end = len(self._opened) + number
        while (left := end - len(self._opened)) > 0:
            may_ask = time.monotonic() > self._refused_s + RETRY_S
            if may_ask and len(self._opening) < min(at_once, left):
                request = secrets.token_hex(8)
                self._opening[request] = time.monotonic()
                self._clients[len(self._opened) % NUM_CLIENTS].send(OpenSession(request=request))
            else:
                self._turn()

    def close_last(self, number: int) -> None:
        """Close the sessions that were opened last."""
        for _ in range(number):
            client, opened = self._opened.pop()
            self.delays_s.pop()
            request = secrets.token_hex(8)
            client.send(CloseSession(session=opened.session, token=opened.token, request=request))

    def _turn(self) -> None:
        for client in self._clients:
            for received in client.receive():
                self._take(client, received.message)
        for worker in self.workers:
            worker.take()
            if time.monotonic() >= worker.due_s:
                worker.due_s = max(worker.due_s + HEARTBEAT_S, time.monotonic())
                worker.beat(self._share)
        time.sleep(TURN_S)

    def _take(self, client: Socket, answer: Message | BadMessage) -> None:
        if isinstance(answer, SessionOpened):
            self.delays_s.append(time.monotonic() - self._opening.pop(answer.request))
            self._opened.append((client, answer))
        elif isinstance(answer, Error):  # every worker has many new sessions, not yet measured
            self._opening.pop(answer.request, None)
            self._refused_s = time.monotonic()


def measure(num_workers: int, num_sessions: int, console: Console) -> Cost:
    """Run a control with so many workers and sessions; return what it costs.

    Raises
    ------
    UserError
        If this process may not open as many files.
    """
    raise_file_limit()
    if resource.getrlimit(resource.RLIMIT_NOFILE)[0] < FILES_OF_WORKER * num_workers + 200:
        raise UserError(f"{num_workers} workers need more open files; see ulimit -n")
    with _control(2 * (num_sessions + NUM_TIMED)) as (control, process, log), ExitStack() as stack:
        cluster = _Cluster(stack, control, num_workers, num_sessions)
        console.print(f"{num_workers} workers: opening {num_sessions} sessions")
        cluster.run(2.0)
        cluster.open(num_sessions, MAX_OPENING)
        cluster.run(SETTLE_S)
        lost_before = log.read_text("utf-8").count('"lost ')
        answered = sum(worker.num_answered for worker in cluster.workers)
        cpu_s, begin_s = _cpu_s(process), time.monotonic()
        cluster.run(MEASURE_S)
        passed_s = time.monotonic() - begin_s
        cpu_share = (_cpu_s(process) - cpu_s) / passed_s
        answered = sum(worker.num_answered for worker in cluster.workers) - answered
        cluster.open(NUM_TIMED, 1)
        delays_ms = 1e3 * np.array(cluster.delays_s[-NUM_TIMED:])
        cluster.close_last(NUM_TIMED)
        return Cost(
            num_workers=num_workers,
            num_sessions=num_sessions,
            heartbeats_per_s=answered / passed_s,
            cpu_share=cpu_share,
            memory_mb=_memory_mb(process),
            open_ms_p50=float(np.percentile(delays_ms, 50)),
            open_ms_p95=float(np.percentile(delays_ms, 95)),
            num_lost=log.read_text("utf-8").count('"lost ') - lost_before,
        )


def show(costs: Sequence[Cost], console: Console) -> None:
    """Print the costs as a table."""
    table = Table(
        "workers", "sessions", "heartbeats a s", "CPU of a core", "memory, MB",
        "open, ms (p50, p95)", "taken for lost",
    )  # fmt: skip
    for cost in costs:
        table.add_row(
            f"{cost.num_workers}",
            f"{cost.num_sessions}",
            f"{cost.heartbeats_per_s:.0f}",
            f"{cost.cpu_share:.0%}",
            f"{cost.memory_mb:.0f}",
            f"{cost.open_ms_p50:.0f}, {cost.open_ms_p95:.0f}",
            f"{cost.num_lost}",
        )
    console.print(table)


@contextmanager
def _control(max_sessions: int) -> Iterator[tuple[str, int, Path]]:
    """Yield where a control of its own takes commands, its process number and its log."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = folder  # keys of its own
        environment = {
            **os.environ,
            **free_addresses(["control"]),
            "KOUXING_CONTROL_MAX_SESSIONS": str(max_sessions),
            "KOUXING_CONTROL_IDLE_LIMIT_S": "86400",
        }
        log = Path(folder) / "log"
        with log.open("wb") as stream:
            process = subprocess.Popen(
                [sys.executable, "-m", "kouxing.services.control"], env=environment, stderr=stream
            )
        try:
            yield control_endpoint(environment["KOUXING_CONTROL"], insecure=False), process.pid, log
        finally:
            process.kill()  # what it would tell 100 000 sessions interests nobody
            process.wait()


def _cpu_s(process: int) -> float:
    """Return the processor time that a process has taken."""
    fields = Path(f"/proc/{process}/stat").read_text("ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory_mb(process: int) -> float:
    """Return the memory that a process takes, in MB of 2^20 bytes."""
    pages = int(Path(f"/proc/{process}/statm").read_text("ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
