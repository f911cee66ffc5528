"""What hostile peers cost: memory of the services, and delay of others' faces.

The services run as under ``kouxing run``, on ports of their own. For each attack a session is
streamed in real time, before, during and after it. The attacker is a process of its own that begins
again as soon as it was cut; the first row is a process that only spins, for the attacker needs a
processor, too. It has no key: where all have one its handshake fails, where none has it may speak.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from evaluation.system.attackers import FLOODS, SUBSCRIPTIONS, TARGETS, Attack, hold_connections
from evaluation.system.latency import percentiles, stream
from evaluation.system.memory import Memory
from services.cli.supervisor import Supervisor
from services.kinds import KINDS, free_addresses
from services.synthesizer.config import SynthesizerConfig
from shared.audio_file import read_audio
from shared.client import Client
from shared.connections import BAN_S
from shared.errors import UserError
from shared.keys import control_endpoint

PHASE_S = 3.0
RETURN_S = 3.0  # for memory to come back
ATTACKED = {  # sockets, by whether others have keys; then nobody else gets far
    False: ("commands", "audio", "faps"),
    True: ("audio",),
}


@dataclass(frozen=True, slots=True)
class Damage:
    """What one attack did; memory in MB of 2^20 bytes, of the service that grew most."""

    keys: bool  # whether all others have one
    attack: str
    socket: str
    growth_mb: float
    kept_mb: float
    before_p95_ms: float | None  # None: no frame came in time
    during_p95_ms: float | None
    after_p95_ms: float | None


def measure(path: Path, console: Console) -> list[Damage]:
    """Start the services and attack them; return the figures.

    Raises
    ------
    UserError
        If the file is no audio or the services cannot start.
    """
    samples, rate_hz = read_audio(path)
    sound = np.resize(samples, (round(3 * PHASE_S * rate_hz), samples.shape[1]))
    return [damage for keys in (False, True) for damage in _measure(sound, rate_hz, keys, console)]


def _measure(
    sound: NDArray[np.float32], rate_hz: int, keys: bool, console: Console
) -> list[Damage]:
    environment = {
        **free_addresses(),
        "KOUXING_DRIVER_VIEW": "none",
        "KOUXING_INSECURE": str(not keys),
        "LP_NUM_THREADS": os.environ.get("LP_NUM_THREADS", "1"),
    }
    control = control_endpoint(environment["KOUXING_CONTROL"], insecure=not keys)
    with tempfile.TemporaryDirectory() as folder:
        supervisor = Supervisor([], Path(folder), console, environment)
        try:
            supervisor.start()
            supervisor.wait_ready(control)
            _p95_ms(control, sound, rate_hz)  # what runs for the first time is slow
            numbers = [supervisor.process_number(service) for service in KINDS]
            return [
                _damage(keys, attack, target, numbers, environment, sound, rate_hz)
                for attack, target in _attacks(ATTACKED[keys])
            ]
        finally:
            supervisor.stop()


def show(damages: list[Damage], console: Console) -> None:
    """Print the figures as a table."""
    table = Table(
        "keys", "attack", "socket", "growth MB", "kept MB", "p95 ms before", "during", "after"
    )
    for damage in damages:
        keys, attack, socket, *figures = asdict(damage).values()
        table.add_row(
            "yes" if keys else "no",
            attack,
            socket,
            *("none" if figure is None else f"{figure:.1f}" for figure in figures),
        )
    console.print(table)


def _attacks(targets: Iterable[str]) -> Iterator[tuple[str, str]]:
    yield "none, but a busy processor", ""
    for target in targets:
        for attack in FLOODS:
            yield attack, target
    for attack in SUBSCRIPTIONS:
        yield attack, "faps"
    yield "very many connections", "audio"


def _damage(
    keys: bool,
    attack: str,
    target: str,
    numbers: list[int],
    environment: Mapping[str, str],
    sound: NDArray[np.float32],
    rate_hz: int,
) -> Damage:
    control = control_endpoint(environment["KOUXING_CONTROL"], insecure=not keys)
    _wait_until_let_in(control)
    memories = [Memory(number) for number in numbers]
    with _attacker(attack, target, environment):
        p95_ms = _p95_ms(control, sound, rate_hz)
    growth_mb = max(memory.growth_mb for memory in memories)
    time.sleep(RETURN_S)
    kept_mb = max(memory.kept_mb for memory in memories)
    return Damage(keys, attack, target, growth_mb, kept_mb, *p95_ms)


def _wait_until_let_in(control: str) -> None:
    """Wait while faults count against this address."""
    for _ in range(2 * BAN_S):
        with contextlib.suppress(UserError), Client(control) as client:
            client.status()
            return
        time.sleep(1.0)


def _p95_ms(control: str, sound: NDArray[np.float32], rate_hz: int) -> list[float | None]:
    """Return the delay before, during and after the attack, of a session that lasts throughout."""
    with Client(control) as client:
        times_s, delays_s, _ = stream(client, sound, rate_hz, SynthesizerConfig().delay_ms / 1e3)
    phases = [delays_s[times_s // PHASE_S == phase] * 1e3 for phase in range(3)]
    return [percentiles(delays_ms)["p95"] if delays_ms.size else None for delays_ms in phases]


@contextlib.contextmanager
def _attacker(attack: str, target: str, environment: Mapping[str, str]) -> Iterator[None]:
    """Let a process attack in the second phase of the three."""
    port, kind = 0, ""
    if target:
        service, setting, kind = TARGETS[target]
        port = int(environment[f"KOUXING_{service.upper()}_{setting}"].rpartition(":")[2])
    context = multiprocessing.get_context("spawn")
    begins = context.Event()
    process = context.Process(target=_attack, args=(attack, port, kind, begins), daemon=True)
    process.start()
    timers = [
        threading.Timer(PHASE_S, begins.set),
        threading.Timer(2 * PHASE_S, process.terminate),
    ]
    for timer in timers:
        timer.start()
    try:
        yield
    finally:
        for timer in timers:
            timer.join()
        process.join()


def _attack(attack: str, port: int, kind: str, begins: Event) -> None:
    """Attack for ever, once it begins; without a port only spin."""
    attacks: dict[str, Attack] = {
        **FLOODS,
        **SUBSCRIPTIONS,
        "very many connections": hold_connections,
    }
    while True:
        if port:
            attacks[attack](port, kind, 1.0)
