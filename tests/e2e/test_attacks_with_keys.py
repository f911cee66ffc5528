"""Hostile peers where all have keys: others are not heard, one that is allowed is bounded."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import zmq

from evaluation.system import attackers
from evaluation.system.memory import Memory
from shared.client import Session
from shared.keys import user_key
from tests.system import System, connect

pytestmark = pytest.mark.e2e

MAX_GROWTH_MB = 64.0
MAX_KEPT_MB = 32.0
SECONDS = 1.0


@pytest.mark.parametrize("target", attackers.TARGETS)
def test_without_a_key_the_handshake_fails(system: System, witness: Session, target: str) -> None:
    service, setting, kind = attackers.TARGETS[target]
    port = int(system.environment[f"KOUXING_{service.upper()}_{setting}"].rpartition(":")[2])
    with pytest.raises(OSError, match=r".+"):
        attackers.connected(port, kind)


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    made: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield made
    made.destroy(linger=0)


def send_for_a_while(raw: zmq.Socket[bytes], data: bytes, flags: int) -> None:
    raw.setsockopt(zmq.SNDTIMEO, 100)
    end_s = time.monotonic() + SECONDS
    number = 0
    while time.monotonic() < end_s:
        number += 1
        try:
            raw.send(data + (b"%08d" % number if data[:1] == b"\x01" else b""), flags)
        except zmq.Again:
            continue


@pytest.mark.parametrize("part", [b"", b"x" * 300, b"x" * 60_000])
@pytest.mark.parametrize("target", ["commands", "audio"])
def test_a_key_that_is_allowed_may_not_send_a_message_without_end(
    system: System,
    witness: Session,
    context: zmq.Context[zmq.Socket[bytes]],
    target: str,
    part: bytes,
) -> None:
    raw = context.socket(zmq.DEALER)
    connect(raw, system.endpoints()[target], user_key())
    memory = Memory(system.processes[attackers.TARGETS[target][0]].pid)
    send_for_a_while(raw, part, zmq.SNDMORE)
    assert memory.growth_mb < MAX_GROWTH_MB
    raw.close()
    assert memory.wait_until_kept(MAX_KEPT_MB), memory.kept_mb


def test_a_key_that_is_allowed_may_not_subscribe_without_end(
    system: System, witness: Session, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    raw = context.socket(zmq.XSUB)
    connect(raw, system.endpoints()["faps"], user_key())
    memory = Memory(system.processes["synthesizer"].pid)
    send_for_a_while(raw, b"\x01" + b"x" * 110, 0)
    assert memory.growth_mb < MAX_GROWTH_MB
    raw.close()
    assert memory.wait_until_kept(MAX_KEPT_MB), memory.kept_mb
