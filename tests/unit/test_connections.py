"""Decisions about connections, without sockets: who is disconnected, and who never."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import cast

import pytest

from kouxing.shared import connections, kernel_sockets
from kouxing.shared.bus import AUDIO
from kouxing.shared.connections import (
    BUDGET,
    BUDGET_PER_S,
    MAX_QUEUED,
    MIN_BUDGET,
    PENALTY_S,
    STALLED_S,
    Budget,
    Connection,
    ConnectionLimiter,
    LimitedSocket,
)
from kouxing.shared.kernel_sockets import Traffic

pytestmark = pytest.mark.unit


@dataclass
class Clock:
    now_s: float = 100.0

    def __call__(self) -> float:
        return self.now_s


@dataclass
class Kernel:
    """What the limiter sees of the kernel; descriptor and inode are the same number."""

    addresses: dict[int, str] = field(default_factory=dict)
    traffic: dict[int, Traffic] = field(default_factory=dict)
    ended: set[int] = field(default_factory=set)

    def inode_of(self, descriptor: int) -> int | None:
        return None if descriptor in self.ended else descriptor

    def reset(self, descriptor: int, inode: int) -> None:
        assert descriptor == inode
        self.ended.add(descriptor)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    made = Kernel()
    monkeypatch.setattr(kernel_sockets, "inode_of", made.inode_of)
    monkeypatch.setattr(kernel_sockets, "reset", made.reset)
    monkeypatch.setattr(kernel_sockets, "port_of", lambda _descriptor: 5560)
    monkeypatch.setattr(kernel_sockets, "address_of", lambda d: made.addresses.get(d, "loopback"))
    monkeypatch.setattr(kernel_sockets, "traffic_of", lambda d: made.traffic.get(d, Traffic()))
    return made


@pytest.fixture
def limiter(monkeypatch: pytest.MonkeyPatch) -> ConnectionLimiter:
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 8)
    monkeypatch.setattr("threading.Thread.start", lambda _thread: None)
    return ConnectionLimiter()


@pytest.fixture
def socket(limiter: ConnectionLimiter, kernel: Kernel) -> LimitedSocket:
    """A bound socket for audio; ``accepted`` yields nothing by itself."""
    raw = SimpleNamespace(setsockopt=lambda *_: None, get_monitor_socket=lambda *_: None)
    made = limiter.limit(raw, AUDIO)  # type: ignore[arg-type]
    made.port = 5560
    made.accepted = lambda: iter(())  # type: ignore[method-assign]
    return made


def deliver(socket: LimitedSocket, descriptor: int, key: str = "") -> Connection:
    return cast(Connection, socket.deliver(descriptor, key))


def test_a_budget_recovers_up_to_its_start_and_a_blocked_one_only_later() -> None:
    clock = Clock()
    budget = Budget(clock=clock)
    budget.spend(BUDGET + BUDGET_PER_S)
    clock.now_s += 2.0
    assert budget.left == BUDGET_PER_S
    clock.now_s += 1000.0
    assert budget.left == BUDGET
    budget.block(3.0)
    clock.now_s += 2.9
    assert budget.left < 0
    clock.now_s += 0.2
    assert budget.left > 0


def test_disconnects_a_peer_whose_message_does_not_end(
    kernel: Kernel, limiter: ConnectionLimiter, socket: LimitedSocket
) -> None:
    hostile, honest = deliver(socket, 1), deliver(socket, 2)
    limiter.look(0.0)
    for look in range(1, 100):
        socket.num_polls += 1
        deliver(socket, 2)
        kernel.traffic = dict.fromkeys((1, 2), Traffic(read=20_000 * look))
        limiter.look(float(look))
    assert hostile.is_cut
    assert not honest.is_cut


def test_waits_for_a_queue_that_is_full(
    kernel: Kernel, limiter: ConnectionLimiter, socket: LimitedSocket
) -> None:
    waiting = deliver(socket, 1)
    limiter.look(0.0)
    kernel.traffic[1] = Traffic(read=(AUDIO.queue_length + 1) * AUDIO.part_bytes)
    for look in range(1, 1000):
        limiter.look(float(look))
    assert not waiting.is_cut


def test_sheds_the_owner_with_the_most_undelivered_bytes(
    kernel: Kernel,
    limiter: ConnectionLimiter,
    socket: LimitedSocket,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connections, "MAX_UNDELIVERED", 700_000)
    many = [deliver(socket, number, "many") for number in (1, 2, 3)]
    single = deliver(socket, 4, "single")
    limiter.look(0.0)
    kernel.traffic = dict.fromkeys((1, 2, 3), Traffic(read=200_000))
    kernel.traffic[4] = Traffic(read=300_000)
    limiter.look(1.0)
    assert sum(connection.is_cut for connection in many) == 1
    assert not single.is_cut


def test_disconnects_those_that_read_too_little(
    kernel: Kernel,
    limiter: ConnectionLimiter,
    socket: LimitedSocket,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connections, "MAX_UNREAD", 3 * MAX_QUEUED)
    silent = [deliver(socket, number, "silent") for number in range(1, 5)]
    other = deliver(socket, 5, "other")
    limiter.look(0.0)
    socket.num_sent += 10 * MAX_QUEUED
    kernel.traffic = dict.fromkeys(range(1, 6), Traffic(acknowledged=1000))
    limiter.look(1.0)
    assert other.unread == 0, "all of them read"
    socket.num_sent += 10 * MAX_QUEUED
    kernel.traffic = dict.fromkeys(range(1, 6), Traffic(acknowledged=1000, unsent=1))
    limiter.look(2.0)
    assert other.unread == MAX_QUEUED, "libzmq drops more"
    assert sum(connection.is_cut for connection in silent) == 2
    assert not other.is_cut


def test_a_subscriber_is_stalled_when_nothing_is_acknowledged(
    kernel: Kernel, limiter: ConnectionLimiter, socket: LimitedSocket
) -> None:
    peer = deliver(socket, 1)
    limiter.look(0.0)
    socket.num_sent += 1
    for now_s in (0.5, 1.5, 2.5):  # slow, but it reads
        kernel.traffic[1] = Traffic(acknowledged=int(now_s * 100), unsent=1)
        limiter.look(now_s)
        assert not peer.is_stalled(now_s)
    assert peer.is_stalled(2.5 + 1.1 * STALLED_S)


@pytest.mark.parametrize("shares", ["key", "address"])
def test_one_peer_cannot_take_all_connections(
    kernel: Kernel, limiter: ConnectionLimiter, socket: LimitedSocket, shares: str
) -> None:
    made = []
    for number in range(1, 9):
        kernel.addresses[number] = "10.0.0.1" if shares == "address" else f"10.0.1.{number}"
        made.append(deliver(socket, number, "key" if shares == "key" else f"key {number}"))
        limiter.look(0.0)
    assert [connection.is_cut for connection in made] == [False] * 6 + [True] * 2


def test_silent_connections_make_room(
    kernel: Kernel, limiter: ConnectionLimiter, socket: LimitedSocket
) -> None:
    kernel.addresses = {number: f"10.0.0.{number}" for number in range(20)}
    silent = [limiter.find(number, socket) for number in range(8)]
    talker = deliver(socket, 8, "talker")
    limiter.look(0.0)
    assert [connection.is_cut for connection in silent if connection] == [True] + [False] * 7
    assert not talker.is_cut


def test_blocks_a_disconnected_owner_but_keeps_its_other_connections(
    kernel: Kernel, limiter: ConnectionLimiter, socket: LimitedSocket
) -> None:
    deliver(socket, 1, "key").disconnect("test", PENALTY_S)
    limiter.look(0.0)
    assert limiter.is_blocked("key")
    assert not limiter.is_blocked("other")
    assert list(socket.ended) == [1]
    honest = deliver(socket, 2, "key")
    assert not honest.is_cut
    assert honest.budget.left >= MIN_BUDGET


def test_a_reused_descriptor_is_another_connection(
    kernel: Kernel,
    limiter: ConnectionLimiter,
    socket: LimitedSocket,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = deliver(socket, 1)
    monkeypatch.setattr(kernel_sockets, "inode_of", lambda _descriptor: 77)
    assert not limiter.has(1)
    assert deliver(socket, 1) is not before
    monkeypatch.setattr(kernel_sockets, "port_of", lambda _descriptor: 80)
    monkeypatch.setattr(kernel_sockets, "inode_of", lambda _descriptor: 78)
    assert socket.deliver(1, "") is None  # another socket of this process


@pytest.mark.parametrize(
    ("first", "second", "is_one"),
    [
        ("127.0.0.1", "127.200.1.1", True),
        ("127.0.0.1", "::1", True),
        ("127.0.0.1", "::ffff:127.0.0.2", True),
        ("10.0.0.1", "10.0.0.2", False),
        ("10.0.0.1", "::ffff:10.0.0.1", True),
        ("2001:db8:0:1::1", "2001:db8:0:1:ffff::2", True),
        ("2001:db8:0:1::1", "2001:db8:0:2::1", False),
        ("fe80::1%eth0", "fe80::2%eth0", True),
        ("", "127.0.0.1", False),  # gone already
    ],
)
def test_the_addresses_of_one_host_count_as_one(first: str, second: str, is_one: bool) -> None:
    assert (kernel_sockets.network_of(first) == kernel_sockets.network_of(second)) == is_one
