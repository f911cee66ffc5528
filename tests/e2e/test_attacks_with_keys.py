"""Hostile peers where all have keys: others are not heard, one that is allowed is bounded."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from kouxing.evaluation.system import attackers
from kouxing.evaluation.system.attacks import wait_until_let_in
from kouxing.evaluation.system.memory import Memory
from kouxing.shared.client import Client, Session
from tests.raw_bytes import pour
from tests.system import System

pytestmark = pytest.mark.e2e

MAX_GROWTH_MB = 64.0
MAX_KEPT_MB = 8.0
SECONDS = 1.0


@pytest.mark.parametrize("target", attackers.TARGETS)
def test_without_a_key_the_handshake_fails(system: System, witness: Session, target: str) -> None:
    service, setting, kind = attackers.TARGETS[target]
    port = int(system.environment[f"KOUXING_{service.upper()}_{setting}"].rpartition(":")[2])
    with pytest.raises(OSError, match=r".+"):
        attackers.connected(port, kind)


@pytest.fixture
def client(system: System) -> Iterator[Client]:
    """A client of the same address, once that is let in again after the attack before."""
    wait_until_let_in(system.control)
    with Client(system.control) as made:
        yield made


@pytest.mark.parametrize(
    ("attack", "target"),
    [
        (attack, target)
        for attack in attackers.ALLOWED
        for target in (("faps",) if "subscriptions" in attack else ("commands", "audio"))
    ],
)
def test_a_key_that_is_allowed_is_bounded(
    system: System, witness: Session, attack: str, target: str
) -> None:
    memory = Memory(system.processes[attackers.TARGETS[target][0]].pid)
    attackers.ALLOWED[attack](system.endpoints()[target], SECONDS)
    assert memory.growth_mb < MAX_GROWTH_MB
    assert memory.wait_until_kept(MAX_KEPT_MB), memory.kept_mb


def test_raw_bytes_at_every_port_harm_nobody(system: System, witness: Session) -> None:
    for port in system.ports:
        pour(port, SECONDS / 4)
    system.assert_all_alive()
    wait_until_let_in(system.control)
