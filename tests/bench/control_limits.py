"""The limits of control: the real service in this process, with fake workers on real sockets.

    python -m tests.bench.control_limits 10 100 1000

For each number of workers, half of them recognizers, 100 sessions per worker are opened and each
worker sends heartbeats with 16 of its sessions. The table shows control's own processor time. It
does not depend on other programs. Workers and sockets of this process do not count.
"""

import resource
import secrets
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import cycle, islice

from rich.console import Console

from kouxing.services.control.config import ControlConfig
from kouxing.services.control.service import ControlService
from kouxing.shared.bus import Bus
from kouxing.shared.connections import raise_file_limit
from kouxing.shared.service import HEARTBEAT_S, SESSIONS_PER_HEARTBEAT
from kouxing.shared.sockets import Socket
from kouxing.shared.terminal import print_table
from kouxing.shared.wire.control import (
    Heartbeat,
    HeartbeatReply,
    SessionInput,
    SessionStarted,
    StartSession,
)
from kouxing.shared.wire.session import Error, OpenSession, SessionOpened
from tests.control_stage import LOCAL, PROVIDED

SESSIONS_PER_WORKER = 100
BATCH = 64  # sessions that are opened at once
SESSIONS_PER_CLIENT = 1000  # control disconnects a client that sends more requests within seconds
ROUNDS = 4  # of heartbeats
SOCKETS_PER_BUS = 250


@dataclass(slots=True)
class FakeWorker:
    """A worker that starts every session at once."""

    kind: str
    number: int
    socket: Socket
    sessions: list[str] = field(default_factory=list)
    num_answered: int = 0

    def beat(self) -> None:
        start = self.num_answered * SESSIONS_PER_HEARTBEAT
        reported = islice(cycle(self.sessions), start, start + SESSIONS_PER_HEARTBEAT)
        self.socket.send(
            Heartbeat(
                service=self.kind,
                instance=f"{self.kind}-{self.number}",
                role="worker",
                state="ready",
                sent_ns=0,
                endpoints=dict.fromkeys(PROVIDED[self.kind], f"tcp://127.0.0.1:{self.number + 1}"),
                needs=["phone_input"] if self.kind == "recognizer" else [],
                sessions={name: SessionInput(sequence=1) for name in reported}
                if self.sessions
                else {},
            )
        )

    def receive(self) -> None:
        for received in self.socket.receive():
            if isinstance(start := received.message, StartSession):
                self.sessions.append(start.session)
                self.socket.send(SessionStarted(session=start.session, request=start.request))
            elif isinstance(received.message, HeartbeatReply):
                self.num_answered += 1


class Simulation:
    """Control with workers and clients."""

    def __init__(self, stack: ExitStack, num_workers: int) -> None:
        self.num_sessions = num_workers * SESSIONS_PER_WORKER // 2
        self.control = ControlService(
            ControlConfig(
                control=LOCAL, events=LOCAL, insecure=True, lost_after_s=3600.0, max_load=1000.0,
                max_sessions=4 * self.num_sessions,
            )
        )  # fmt: skip
        stack.callback(self.control.bus.close)
        self.cpu_s = 0.0
        self.workers = []
        for number in range(num_workers):
            if number % SOCKETS_PER_BUS == 0:
                bus = stack.enter_context(Bus(None))
            socket = bus.connect_dealer(self.control.endpoints["commands"])
            self.workers.append(FakeWorker(list(PROVIDED)[number % 2], number, socket))
        client_bus = stack.enter_context(Bus(None))
        self.clients = [
            client_bus.connect_dealer(self.control.endpoints["commands"])
            for _ in range(0, self.num_sessions, SESSIONS_PER_CLIENT)
        ]

    def beat(self) -> float:
        """Return control's processor time for a heartbeat of every worker, seconds."""
        cpu_s = self.cpu_s
        answered = [worker.num_answered + 1 for worker in self.workers]
        for worker in self.workers:
            worker.beat()
        while [worker.num_answered for worker in self.workers] != answered:
            self._step()
        return self.cpu_s - cpu_s

    def open_sessions(self) -> float:
        """Return control's processor time for opening all sessions, seconds."""
        cpu_s, num_opened = self.cpu_s, 0
        for start in range(0, self.num_sessions, BATCH):
            end = min(start + BATCH, self.num_sessions)
            for number in range(start, end):
                request = secrets.token_hex(8)
                client = self.clients[number // SESSIONS_PER_CLIENT]
                client.send(OpenSession(request=request, session=f"s{number}"))
            while num_opened < end:
                self._step()
                for client in self.clients:
                    for received in client.receive():
                        assert not isinstance(received.message, Error), received.message
                        num_opened += isinstance(received.message, SessionOpened)
        return self.cpu_s - cpu_s

    def _step(self) -> None:
        start_s = time.thread_time()
        self.control.step(0.0)
        self.cpu_s += time.thread_time() - start_s
        for worker in self.workers:
            worker.receive()


def main(numbers: list[int]) -> None:
    raise_file_limit()
    rows = []
    for num_workers in numbers:
        with ExitStack() as stack:
            simulation = Simulation(stack, num_workers)
            simulation.beat()
            open_s = simulation.open_sessions()
            beat_s = sum(simulation.beat() for _ in range(ROUNDS)) / ROUNDS
            memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            rows.append(
                [
                    str(num_workers),
                    str(simulation.num_sessions),
                    f"{1e3 * open_s / simulation.num_sessions:.2f}",
                    f"{1e3 * beat_s / num_workers:.2f}",
                    f"{beat_s / HEARTBEAT_S:.3f}",
                    f"{memory_mb:.0f}",
                ]
            )
    columns = ("workers", "sessions", "ms per open", "ms per heartbeat", "cores", "MB, all fakes")
    print_table(Console(), "control", columns, rows)


if __name__ == "__main__":
    main([int(number) for number in sys.argv[1:]])
