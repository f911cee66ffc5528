"""Measures what attackers cost: memory of each service, and delay of another client's frames.

The services run as under ``kouxing run``, with keys, on free ports. During each attack a session
is streamed in real time: before, during and after it. The attacker is a separate process, which
starts over whenever it is cut off. It has its own process session, like any other program.
In the caller's session, it would have the caller's priority, which can exceed the services'. The
first row is a process that only keeps a core busy, because an attacker also takes processor time.

On Linux only: memory is read from ``/proc``.
"""

import contextlib
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
from rich.console import Console

from kouxing.evaluation.percentiles import percentiles
from kouxing.evaluation.system.attackers import ATTACKS
from kouxing.evaluation.system.latency import stream
from kouxing.evaluation.system.systems import LocalSystem, run_all_services
from kouxing.evaluation.system.wait import wait_until
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.service_kinds import KINDS
from kouxing.shared.arrays import Floats
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.errors import UserError

PHASES = ("before", "during", "after")
PHASE_S = 3.0
SESSION_START_S = 0.5
RELEASE_DEADLINE_S = 15.0
RELEASED_MB = 4.0  # a service that has grown by no more has released the memory


class MemoryUsage:
    """Memory of a process, relative to when this object was made; MB of 2^20 bytes."""

    def __init__(self, process_id: int) -> None:
        self._folder = Path(f"/proc/{process_id}")
        self._start_mb = self._read_mb("VmRSS")
        self.restart_growth()

    def restart_growth(self) -> None:
        """Measure the growth from now on."""
        (self._folder / "clear_refs").write_text("5")  # resets the peak
        self._before_growth_mb = self._read_mb("VmRSS")

    @property
    def growth_mb(self) -> float:
        """Peak growth since the start, or since ``restart_growth``."""
        return self._read_mb("VmHWM") - self._before_growth_mb

    @property
    def kept_mb(self) -> float:
        """Growth at present."""
        return self._read_mb("VmRSS") - self._start_mb

    def wait_until_kept(self, limit_mb: float, timeout_s: float) -> bool:
        """Wait until ``kept_mb`` is at most ``limit_mb``; return False after the timeout."""
        return wait_until(lambda: self.kept_mb <= limit_mb, timeout_s)

    def _read_mb(self, name: str) -> float:
        lines = (self._folder / "status").read_text("ascii").splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith(f"{name}:"))) / 1024


@dataclass(frozen=True, slots=True)
class AttackResult:
    """Effects of one attack. Memory is in MB of 2^20 bytes."""

    attack: str
    target: str
    has_key: bool
    growth_mb: dict[str, float]  # peak during and after the attack, by service
    kept_mb: dict[str, float]  # after up to RELEASE_DEADLINE_S, by service
    restarted: list[str]  # services that ended during the attack; they have no memory figures
    p95_ms: dict[str, float | None]  # the other client's p95, by phase; None: no frame in time


def measure(path: Path, console: Console) -> list[AttackResult]:
    """Start the services, attack them in each way and return the figures.

    The other client streams the file. Raises ``UserError`` if the file is not audio.
    """
    length_s = len(PHASES) * PHASE_S + 2 * SESSION_START_S
    speech = np.resize(to_16_khz(*read_audio(path)), round(length_s * MEDIA_RATE_HZ))
    runs = [(name, target) for name, attack in ATTACKS.items() for target in attack.targets]
    with run_all_services(console) as system:
        _delays_ms(system.control, speech)  # the first session of a process is slow
        results = []
        for number, (name, target) in enumerate(runs, start=2):
            console.print(f"attack: {name}" + (f" on {target}" if target else ""))
            # A new source address each time: a service may reject one that has misbehaved.
            results.append(_result(system, name, target, f"127.0.0.{number}", speech))
        return results


def _result(
    system: LocalSystem, name: str, target: str, source: str, speech: Floats
) -> AttackResult:
    with connect_client(system.control) as client:
        services = client.status().services
    endpoints = {key: endpoint for state in services for key, endpoint in state.endpoints.items()}
    processes = {kind: system.supervisor.process(kind).pid for kind in KINDS}
    memories = {kind: MemoryUsage(process_id) for kind, process_id in processes.items()}

    def restart_growth() -> None:  # the memory of the other client's session is now allocated
        for memory in memories.values():
            memory.restart_growth()

    with _attacker(name, endpoints.get(target, ""), source, restart_growth):
        delays_ms = _delays_ms(system.control, speech)
    restarted = [kind for kind in KINDS if system.supervisor.process(kind).pid != processes[kind]]
    for kind in restarted:
        del memories[kind]
    growth_mb = {kind: memory.growth_mb for kind, memory in memories.items()}
    deadline_s = time.monotonic() + RELEASE_DEADLINE_S
    for memory in memories.values():
        memory.wait_until_kept(RELEASED_MB, deadline_s - time.monotonic())
    kept_mb = {kind: memory.kept_mb for kind, memory in memories.items()}
    has_key = ATTACKS[name].has_key
    return AttackResult(name, target, has_key, growth_mb, kept_mb, restarted, delays_ms)


def _delays_ms(control: str, speech: Floats) -> dict[str, float | None]:
    """Stream a session through all phases; return the 95th percentile of its delays by phase."""
    with connect_client(control) as client, client.open_session(encoding="f32le") as session:
        times_s, delays_s, _ = stream(session, speech)
    phase_ends_s = np.array([PHASE_S, 2 * PHASE_S + 2 * SESSION_START_S])
    phase = np.digitize(times_s, phase_ends_s)
    delays_ms = [delays_s[phase == number] * 1e3 for number in range(len(PHASES))]
    p95_ms = [percentiles(values).get("p95") for values in delays_ms]
    return dict(zip(PHASES, p95_ms, strict=True))


@contextlib.contextmanager
def _attacker(
    name: str, endpoint: str, source: str, on_start: Callable[[], None]
) -> Iterator[None]:
    """Run an attacking process during the second phase; call ``on_start`` before it."""
    context = multiprocessing.get_context("spawn")
    start = context.Event()

    def begin_attack() -> None:
        on_start()
        start.set()

    process = context.Process(target=_attack, args=(name, endpoint, source, start), daemon=True)
    process.start()
    begin = threading.Timer(PHASE_S + SESSION_START_S, begin_attack)
    end = threading.Timer(2 * PHASE_S + SESSION_START_S, process.terminate)
    begin.start()
    end.start()
    try:
        yield
    finally:  # after an error or Ctrl-C, the attack must not continue
        begin.cancel()
        end.cancel()
        process.terminate()
        process.join()


def _attack(name: str, endpoint: str, source: str, start: Event) -> None:
    """Attack until the process is terminated."""
    os.setsid()
    start.wait()
    while True:
        with contextlib.suppress(OSError, UserError):  # rejected or cut off
            ATTACKS[name].run(endpoint, source, PHASE_S)
