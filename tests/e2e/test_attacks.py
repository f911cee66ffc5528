"""Hostile peers at every socket: little memory, none of it kept, and other sessions go on."""

from __future__ import annotations

import contextlib
import math
import resource
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from kouxing.evaluation.system import attackers
from kouxing.evaluation.system.memory import Memory
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.client import Client, Session
from kouxing.shared.connections import MAX_CONNECTIONS
from kouxing.shared.wire.face import FapFrame
from tests.e2e.following import stream
from tests.raw_bytes import pour
from tests.system import System

pytestmark = pytest.mark.e2e

MAX_GROWTH_MB = 64.0
MAX_KEPT_MB = 8.0
SECONDS = 1.0


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """A system without keys: its peers get so far as to say something."""
    folder = tmp_path_factory.mktemp("system")
    with System(("control", "recognizer", "synthesizer"), folder, insecure=True) as running:
        yield running


def port_of(system: System, target: str) -> int:
    service, setting, _ = attackers.TARGETS[target]
    return int(system.environment[f"KOUXING_{service.upper()}_{setting}"].rpartition(":")[2])


def is_let_in(port: int, kind: str) -> bool:
    """Whether a new connection of this address stays."""
    try:
        with attackers.connected(port, kind) as connection:
            connection.settimeout(0.1)
            while connection.recv(1000):
                pass
    except TimeoutError:
        return True
    except OSError:
        pass
    return False


@pytest.fixture
def client(system: System) -> Iterator[Client]:
    """A client of the same address, once that is let in again after the attack before."""
    end_s = time.monotonic() + 60
    for target, (_, _, kind) in attackers.TARGETS.items():
        while not is_let_in(port_of(system, target), kind):
            assert time.monotonic() < end_s, "it is not let in again"
            time.sleep(0.2)
    with Client(system.control) as made:
        yield made


class LiveFace:
    """A live session of which at most a second may be missing when something has gone on."""

    def __init__(self, control: str) -> None:
        self._control = control
        self._begins, self._ends = threading.Event(), threading.Event()
        self._pool = ThreadPoolExecutor(1)
        self._num_missing: Future[int]  # frames

    def __enter__(self) -> Self:
        self._num_missing = self._pool.submit(self._speak)
        assert self._begins.wait(30.0)
        return self

    def __exit__(self, *exc: object) -> None:
        self._ends.set()
        self._pool.shutdown(wait=False)
        assert self._num_missing.result(30.0) < 50 + SynthesizerConfig().delay_ms / 20

    def _speak(self) -> int:
        with Client(self._control) as client:
            session = client.open_session()
            output = session.subscribe(FapFrame)
            num_sent = num_frames = 0
            begin_s, last_s = time.monotonic(), math.inf
            while time.monotonic() < last_s:
                if self._ends.is_set() and last_s == math.inf:
                    last_s = time.monotonic() + 0.5
                if last_s == math.inf and time.monotonic() > begin_s + 0.02 * num_sent:
                    num_sent += session.send(np.zeros(320, np.int16))
                output.wait(0.01)
                num_frames += sum(isinstance(r.message, FapFrame) for r in output.receive())
                if num_frames:
                    self._begins.set()
            session.close()
        return max(0, num_sent - num_frames)


@pytest.mark.parametrize("attack", attackers.FLOODS)
@pytest.mark.parametrize("target", ["commands", "audio", "faps"])
def test_a_flood_takes_little_memory_and_leaves_none(
    system: System, witness: Session, target: str, attack: str
) -> None:
    service, _, kind = attackers.TARGETS[target]
    port = port_of(system, target)
    memory = Memory(system.processes[service].pid)
    with LiveFace(system.control):
        attackers.FLOODS[attack](port, kind, SECONDS)
    assert memory.growth_mb < MAX_GROWTH_MB
    assert memory.wait_until_kept(MAX_KEPT_MB), memory.kept_mb


@pytest.mark.parametrize("attack", attackers.SUBSCRIPTIONS)
def test_subscriptions_are_bounded_in_length_and_number(
    system: System, witness: Session, attack: str
) -> None:
    port = int(system.environment["KOUXING_SYNTHESIZER_FAPS"].rpartition(":")[2])
    memory = Memory(system.processes["synthesizer"].pid)
    with LiveFace(system.control):
        attackers.SUBSCRIPTIONS[attack](port, "SUB", SECONDS)
    assert memory.growth_mb < MAX_GROWTH_MB
    assert memory.wait_until_kept(MAX_KEPT_MB), memory.kept_mb


@pytest.mark.parametrize("attack", attackers.SESSIONS)
def test_what_nobody_takes_is_bounded(system: System, witness: Session, attack: str) -> None:
    memory = Memory(system.processes["synthesizer"].pid)
    with LiveFace(system.control):
        attackers.SESSIONS[attack](system.control, 4 * SECONDS)
    assert memory.growth_mb < MAX_GROWTH_MB
    assert memory.wait_until_kept(MAX_KEPT_MB), memory.kept_mb


@pytest.fixture
def few_files(tmp_path: Path) -> Iterator[System]:
    """A system started where a process may open no more files than it needs, and raise that."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        running = System(("control", "recognizer", "synthesizer"), tmp_path, insecure=True)
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


def test_raw_bytes_at_every_port_harm_nobody(system: System, witness: Session) -> None:
    for port in system.ports:
        pour(port, SECONDS)
    system.assert_all_alive()
