"""What hostile peers cost: memory of the services, and delay of others' faces.

The services run as under ``kouxing run``, on ports of their own. For each attack a session is
streamed in real time, before, during and after it. The attacker is a process of its own that begins
again as soon as it was cut; the first row is a process that only spins, for the attacker needs a
processor, too. Without a key its handshake fails where all have one; where none has it may speak.
Other attackers have a key that control lets in.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import socket
import tempfile
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.system.attackers import (
    ALLOWED,
    FLOODS,
    PAGE,
    SESSIONS,
    SUBSCRIPTIONS,
    TARGETS,
    Attack,
    hold_connections,
)
from kouxing.evaluation.system.latency import percentiles, stream
from kouxing.evaluation.system.memory import Memory
from kouxing.evaluation.system.systems import LocalSystem
from kouxing.services.kinds import KINDS
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.audio_file import read_audio
from kouxing.shared.client import Client
from kouxing.shared.connection import BAN_S, KIB
from kouxing.shared.errors import UserError

PHASE_S = 3.0
SLACK_S = 0.5  # in which a session opens
RETURN_S = 15.0  # for memory to come back, unless this much at most is kept already
LITTLE_MB = 4.0
LET_IN_S = 0.5  # that a connection lasts unless it is cut
AT_ENDPOINT = {**ALLOWED, **SESSIONS}  # the others attack a port
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


def measure(path: Path, names: Collection[str], console: Console) -> list[Damage]:
    """Start the services and attack them; return the figures.

    Parameters
    ----------
    names
        Of attacks; empty: all.

    Raises
    ------
    UserError
        If there is no such attack, the file is no audio, or the services cannot start.
    """
    known = dict.fromkeys(name for keys in (False, True) for name, _ in _attacks(keys))
    if unknown := [name for name in names if name not in known]:
        raise UserError(f"{unknown[0]!r} is no attack; there are {', '.join(known)}")
    samples, rate_hz = read_audio(path)
    sound = np.resize(samples, (round((3 * PHASE_S + 2 * SLACK_S) * rate_hz), samples.shape[1]))
    return [
        damage
        for keys in (False, True)
        for damage in _measure(sound, rate_hz, keys, names or known, console)
    ]


def _measure(
    sound: NDArray[np.float32],
    rate_hz: int,
    keys: bool,
    names: Collection[str],
    console: Console,
) -> list[Damage]:
    attacks = [(name, target) for name, target in _attacks(keys) if name in names]
    if not attacks:
        return []
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalSystem(Path(folder), console, insecure=not keys) as system,
    ):
        _p95_ms(system.control, sound, rate_hz)  # what runs for the first time is slow
        numbers = [system.supervisor.process_number(service) for service in KINDS]
        endpoints = _endpoints(system.control)
        return [
            _damage(keys, attack, target, numbers, endpoints, sound, rate_hz)
            for attack, target in attacks
        ]


def _endpoints(control: str) -> dict[str, str]:
    """Return where everything is bound, with its key, by name."""
    with Client(control) as client:
        services = client.status().services
    return {name: each for state in services for name, each in state.endpoints.items()}


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


def _attacks(keys: bool) -> Iterator[tuple[str, str]]:
    """Yield each attack and the socket that it attacks."""
    yield "none, but a busy processor", ""
    for target in ATTACKED[keys]:
        for attack in FLOODS:
            yield attack, target
    for attack in SUBSCRIPTIONS:
        yield attack, "faps"
    for attack in SESSIONS:
        yield attack, "commands"
    yield "very many connections", "audio"
    if keys:
        for attack in ALLOWED:
            targets = ("faps",) if "subscriptions" in attack else ("commands", "audio")
            yield from ((attack, target) for target in targets)
        for attack in PAGE:
            yield attack, "page"


def _damage(
    keys: bool,
    attack: str,
    target: str,
    numbers: list[int],
    endpoints: Mapping[str, str],
    sound: NDArray[np.float32],
    rate_hz: int,
) -> Damage:
    control = endpoints["commands"]
    wait_until_let_in(control)
    memories = [Memory(number) for number in numbers]
    with _attacker(attack, target, endpoints.get(target, "")):
        p95_ms = _p95_ms(control, sound, rate_hz)
    growth_mb = max(memory.growth_mb for memory in memories)
    end_s = time.monotonic() + RETURN_S
    for memory in memories:
        memory.wait_until_kept(LITTLE_MB, end_s - time.monotonic())
    kept_mb = max(memory.kept_mb for memory in memories)
    return Damage(keys, attack, target, growth_mb, kept_mb, *p95_ms)


def wait_until_let_in(control: str) -> None:
    """Wait while faults count against this address: a connection of it is cut then."""
    host, port = control.partition(" ")[0].removeprefix("tcp://").rsplit(":", 1)
    for _ in range(2 * BAN_S):
        with (
            contextlib.suppress(ConnectionError),
            socket.create_connection((host, int(port)), LET_IN_S) as connection,
        ):
            try:
                while connection.recv(KIB):  # the greeting, then nothing
                    pass
            except TimeoutError:
                return
        time.sleep(1.0)


def _p95_ms(control: str, sound: NDArray[np.float32], rate_hz: int) -> list[float | None]:
    """Return the delay before, during and after the attack, of a session that lasts throughout."""
    with Client(control) as client:
        times_s, delays_s, _ = stream(client, sound, rate_hz, SynthesizerConfig().delay_ms / 1e3)
    ends_s = np.array([PHASE_S, 2 * PHASE_S + 2 * SLACK_S])
    phases = [delays_s[np.digitize(times_s, ends_s) == phase] * 1e3 for phase in range(3)]
    return [percentiles(delays_ms)["p95"] if delays_ms.size else None for delays_ms in phases]


@contextlib.contextmanager
def _attacker(attack: str, target: str, endpoint: str) -> Iterator[None]:
    """Let a process attack in the second phase of the three."""
    context = multiprocessing.get_context("spawn")
    begins = context.Event()
    arguments = (attack, target, endpoint, begins)
    process = context.Process(target=_attack, args=arguments, daemon=True)
    process.start()
    timers = [
        threading.Timer(PHASE_S + SLACK_S, begins.set),
        threading.Timer(2 * PHASE_S + SLACK_S, process.terminate),
    ]
    for timer in timers:
        timer.start()
    try:
        yield
    finally:
        for timer in timers:
            timer.join()
        process.join()


def _attack(attack: str, target: str, endpoint: str, begins: Event) -> None:
    """Attack for ever, once it begins; without an endpoint only spin."""
    attacks: dict[str, Attack] = {
        **FLOODS,
        **SUBSCRIPTIONS,
        **PAGE,
        "very many connections": hold_connections,
    }
    begins.wait()
    while True:
        if not endpoint:
            continue
        with contextlib.suppress(OSError):  # refused
            if attack in AT_ENDPOINT:
                AT_ENDPOINT[attack](endpoint, 1.0)
            else:
                address = endpoint.partition(" ")[0].rstrip("/")
                kind = TARGETS[target][2] if target in TARGETS else ""
                attacks[attack](int(address.rpartition(":")[2]), kind, 1.0)
