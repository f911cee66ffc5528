"""Attackers at every socket: services stay alive, release memory, and serve other clients."""

import pytest
from kouxing_client import Session

from kouxing.evaluation.system import attackers
from kouxing.evaluation.system.attackers import ATTACKS, BUSY_PROCESSOR
from kouxing.evaluation.system.attacks import Memory
from tests.raw_bytes import pour
from tests.system import System

SERVICES = {"commands": "control", "audio": "recognizer", "faps": "synthesizer"}  # by target
MAX_GROWTH_MB = {False: 8.0, True: 64.0}  # without a key, with a key
MAX_KEPT_MB = 8.0
SECONDS = 0.5
RUNS = [
    (name, [target for target in attack.targets if target in SERVICES][-1])
    for name, attack in ATTACKS.items()
    if name != BUSY_PROCESSOR and SERVICES.keys() & {*attack.targets}
]


@pytest.mark.parametrize(("name", "target"), RUNS)
def test_limits_the_damage_of_an_attack(
    system: System, witness: Session, name: str, target: str
) -> None:
    attack = ATTACKS[name]
    memory = Memory(system.process(SERVICES[target]).pid)
    source = f"127.0.1.{2 + RUNS.index((name, target))}"
    attack.run(system.endpoints()[target], source, SECONDS)
    assert memory.growth_mb < MAX_GROWTH_MB[attack.has_key]
    assert memory.wait_until_kept(MAX_KEPT_MB, 60.0), memory.kept_mb


@pytest.mark.parametrize(
    ("target", "kind"), [("commands", "DEALER"), ("audio", "DEALER"), ("faps", "SUB")]
)
def test_rejects_a_handshake_without_a_key(system: System, target: str, kind: str) -> None:
    port = int(system.endpoints()[target].partition(" ")[0].rpartition(":")[2])
    with pytest.raises(OSError, match=r".+"):
        attackers.connected(port, kind, "127.0.2.1")


def test_survives_random_bytes_at_every_port(system: System, witness: Session) -> None:
    for port in system.ports:
        pour(port, SECONDS / 4)
    system.assert_all_alive()
