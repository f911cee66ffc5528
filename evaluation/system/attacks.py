"""What hostile peers cost: memory of the services, and delay of others' faces.

The services run as under ``kouxing run``, on ports of their own. For each attack a sentence is
streamed in real time before, during and after it. The attacker is a process of its own that begins
again as soon as it was cut; the first row is a process that only spins, for the attacker needs a
processor, too. It has no key: where all have one its handshake fails, where none has it may speak.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
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
from shared.keys import control_endpoint

STREAMED_S = 3.0
RETURN_S = 3.0  # for memory to come back


@dataclass(frozen=True, slots=True)
class Damage:
    """What one attack did; memory in MB of 2^20 bytes, of the service that grew most."""

    keys: bool  # whether all others have one
    attack: str
    socket: str
    growth_mb: float
    kept_mb: float
    before_p95_ms: float
    during_p95_ms: float
    after_p95_ms: float


def measure(path: Path, console: Console) -> list[Damage]:
    """Start the services and attack them; return the figures.

    Raises
    ------
    UserError
        If the file is no audio or the services cannot start.
    """
    samples, rate_hz = read_audio(path)
    sentence = np.ascontiguousarray(samples[: round(STREAMED_S * rate_hz)])
    return [
        damage for keys in (False, True) for damage in _measure(sentence, rate_hz, keys, console)
    ]


def _measure(
    sentence: NDArray[np.float32], rate_hz: int, keys: bool, console: Console
) -> list[Damage]:
    environment = {
        **free_addresses(),
        "KOUXING_DRIVER_VIEW": "none",
        "KOUXING_INSECURE": str(not keys),
        "LP_NUM_THREADS": os.environ.get("LP_NUM_THREADS", "1"),
    }
    control = control_endpoint(environment["KOUXING_CONTROL"], insecure=not keys)
    delay_s = SynthesizerConfig().delay_ms / 1e3

    def p95_ms() -> float:
        with Client(control) as client:
            to_frame_s, _ = stream(client, sentence, rate_hz, delay_s)
        return percentiles(to_frame_s * 1e3)["p95"]

    with tempfile.TemporaryDirectory() as folder:
        supervisor = Supervisor([], Path(folder), console, environment)
        try:
            supervisor.start()
            supervisor.wait_ready(control)
            p95_ms()  # what runs for the first time is slow
            numbers = [supervisor.process_number(service) for service in KINDS]
            return [
                _damage(keys, attack, target, numbers, environment, p95_ms)
                for attack, target in _attacks(list(TARGETS) if not keys else ["audio"])
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
            "yes" if keys else "no", attack, socket, *(f"{figure:.1f}" for figure in figures)
        )
    console.print(table)


def _attacks(targets: list[str]) -> Iterator[tuple[str, str]]:
    yield "none, but a busy processor", ""
    for target in targets:
        for attack in FLOODS:
            yield attack, target
    for attack in SUBSCRIPTIONS:
        yield attack, "faps"
    yield "very many connections", targets[0]


def _damage(
    keys: bool,
    attack: str,
    target: str,
    numbers: list[int],
    environment: Mapping[str, str],
    p95_ms: Callable[[], float],
) -> Damage:
    before_ms = p95_ms()
    memories = [Memory(number) for number in numbers]
    with _attacker(attack, target, environment):
        during_ms = p95_ms()
    growth_mb = max(memory.growth_mb for memory in memories)
    time.sleep(RETURN_S)
    kept_mb = max(memory.kept_mb for memory in memories)
    return Damage(keys, attack, target, growth_mb, kept_mb, before_ms, during_ms, p95_ms())


@contextlib.contextmanager
def _attacker(attack: str, target: str, environment: Mapping[str, str]) -> Iterator[None]:
    port, kind = 0, ""
    if target:
        service, setting, kind = TARGETS[target]
        port = int(environment[f"KOUXING_{service.upper()}_{setting}"].rpartition(":")[2])
    process = multiprocessing.get_context("spawn").Process(
        target=_attack, args=(attack, port, kind), daemon=True
    )
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


def _attack(attack: str, port: int, kind: str) -> None:
    """Attack for ever; without a port only spin."""
    attacks: dict[str, Attack] = {
        **FLOODS,
        **SUBSCRIPTIONS,
        "very many connections": hold_connections,
    }
    while True:
        if port:
            attacks[attack](port, kind, 1.0)
