"""Hostile peers at every socket: little memory, none of it kept, and other sessions go on."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from evaluation.system import attackers
from evaluation.system.memory import Memory
from shared.client import Session
from shared.connections import MAX_CONNECTIONS
from tests.e2e.following import stream
from tests.system import System

pytestmark = pytest.mark.e2e

MAX_GROWTH_MB = 64.0
MAX_KEPT_MB = 16.0
SECONDS = 1.0
PORTS = {  # of a socket of each kind: its service, its key, and the kind of its peers
    "commands": ("control", "COMMANDS", "DEALER"),
    "events": ("control", "EVENTS", "SUB"),
    "audio": ("recognizer", "AUDIO", "DEALER"),
    "phone_input": ("synthesizer", "PHONE_INPUT", "DEALER"),
    "faps": ("synthesizer", "FAPS", "SUB"),
}
Attack = Callable[[int, str], object]


def together(num: int, attack: Callable[[], object]) -> None:
    """Attack over several connections at once; that one is refused ends none of the others."""

    def one(_: int) -> None:
        with contextlib.suppress(ConnectionError):
            attack()

    with ThreadPoolExecutor(num) as pool:
        list(pool.map(one, range(num)))


def endless(part: bytes, num: int) -> Attack:
    return lambda port, kind: together(
        num, lambda: attackers.endless_message(port, kind, part, SECONDS)
    )


def floods(body: bytes, num: int) -> Attack:
    return lambda port, kind: together(
        num, lambda: attackers.many_messages(port, kind, body, SECONDS)
    )


ATTACKS: dict[str, Attack] = {
    "an endless message of large parts": endless(b"x" * 65_536, 1),
    "an endless message of small parts": endless(b"x" * 300, 1),
    "endless messages of empty parts": endless(b"", 4),
    "a message of very many parts": lambda port, kind: attackers.many_parts(port, kind, 200_000),
    "messages of 1 MiB": floods(b"x" * 2**20, 4),
    "messages of the largest size": floods(b"x" * 65_000, 4),
    "small messages": floods(b"x" * 10, 1),
}


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize("target", PORTS)
def test_a_flood_takes_little_memory_and_leaves_none(
    system: System, witness: Session, target: str, attack: str
) -> None:
    service, key, kind = PORTS[target]
    port = int(system.environment[f"KOUXING_{service.upper()}_{key}"].rpartition(":")[2])
    memory = Memory(system.processes[service].pid)
    ATTACKS[attack](port, kind)
    assert memory.growth_mb < MAX_GROWTH_MB
    assert memory.wait_until_kept(MAX_KEPT_MB), memory.kept_mb


@pytest.mark.parametrize("num_bytes", [120, 2**20])
def test_subscriptions_are_bounded_in_length_and_number(
    system: System, witness: Session, num_bytes: int
) -> None:
    port = int(system.environment["KOUXING_SYNTHESIZER_FAPS"].rpartition(":")[2])
    memory = Memory(system.processes["synthesizer"].pid)
    together(12, partial(attackers.many_subscriptions, port, num_bytes, SECONDS))
    assert memory.growth_mb < MAX_GROWTH_MB
    assert memory.wait_until_kept(MAX_KEPT_MB), memory.kept_mb


@pytest.fixture
def few_files(tmp_path: Path) -> Iterator[System]:
    """A system started where a process may open no more files than it needs, and raise that."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        running = System(("control", "recognizer", "synthesizer"), tmp_path)
        running.__enter__()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with contextlib.closing(contextlib.ExitStack()) as stack:
        stack.push(running)
        yield running


def test_with_very_many_connections_sessions_still_open(few_files: System) -> None:
    with contextlib.ExitStack() as held:
        for service, key in (("control", "COMMANDS"), ("recognizer", "AUDIO")):
            port = int(few_files.environment[f"KOUXING_{service.upper()}_{key}"].rpartition(":")[2])
            held.enter_context(attackers.many_connections(port, MAX_CONNECTIONS + 200))
        assert stream(few_files.control, np.zeros(3200, np.float32)).ended
    few_files.assert_all_alive()
