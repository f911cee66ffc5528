"""Decisions about connections, without sockets: who is disconnected, and who never."""

from collections.abc import Iterable
from types import SimpleNamespace
from typing import cast
from unittest import mock

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.network import connection_limits, kernel_sockets, peer_quota
from kouxing.shared.network.bus import AUDIO_LIMITS
from kouxing.shared.network.connection_limits import (
    NUM_ENDED_BEFORE_TRIM,
    NUM_NEW_CHECKS,
    TRIMS_S,
    ConnectionLimiter,
)
from kouxing.shared.network.kernel_sockets import Traffic
from kouxing.shared.network.peer_connection import PENALTY_S, PeerConnection
from kouxing.shared.network.peer_quota import BUDGET, BUDGET_PER_S, MIN_BUDGET, PeerBudget
from kouxing.shared.network.socket_limits import MAX_QUEUED
from kouxing.shared.network.tarpit import GAP_S, HOLD_S


class SocketHarness:
    """A bound socket for audio; descriptor and inode of a connection are the same number."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.patch = patch
        self.addresses: dict[int, str] = {}
        self.traffic: dict[int, Traffic] = {}
        self.ended: set[int] = set()
        self.held: dict[int, mock.Mock] = {}
        patch.setattr(kernel_sockets, "get_inode", lambda d: None if d in self.ended else d)
        patch.setattr(kernel_sockets, "reset", lambda d, _inode: self.ended.add(d))
        patch.setattr(kernel_sockets, "hold", self.hold)
        patch.setattr(kernel_sockets, "get_local_port", lambda _descriptor: 5560)
        patch.setattr(
            kernel_sockets, "get_peer_address", lambda d: self.addresses.get(d, "loopback")
        )
        patch.setattr(kernel_sockets, "get_traffic", lambda d: self.traffic.get(d, Traffic()))
        patch.setattr(peer_quota, "MAX_CONNECTIONS", 10)
        patch.setattr("threading.Thread.start", lambda _thread: None)
        self.limiter = ConnectionLimiter(is_service=lambda key: key == "service")
        monitor = SimpleNamespace(getsockopt=lambda _option: 10**6)
        raw = SimpleNamespace(setsockopt=lambda *_: None, get_monitor_socket=lambda *_: monitor)
        self.socket = self.limiter.limit(raw, AUDIO_LIMITS)  # type: ignore[arg-type]
        self.socket.port = 5560
        self.socket.accepted = lambda: iter(())  # type: ignore[method-assign]
        self.enforce_limits = self.limiter.enforce_limits

    def hold(self, descriptor: int, _inode: int) -> mock.Mock:
        self.ended.add(descriptor)
        self.held[descriptor] = mock.Mock()
        return self.held[descriptor]

    def deliver(self, descriptor: int, key: str = "") -> PeerConnection:
        return cast(PeerConnection, self.socket.count_delivery(descriptor, key))


@pytest.fixture
def harness(monkeypatch: pytest.MonkeyPatch) -> SocketHarness:
    return SocketHarness(monkeypatch)


def disconnected(connections: Iterable[PeerConnection | None]) -> list[PeerConnection]:
    return [connection for connection in connections if connection and connection.is_disconnected]


def test_a_budget_recovers_and_a_blocked_one_recovers_later() -> None:
    now_s = 100.0
    budget = PeerBudget(clock=lambda: now_s)
    budget.spend(BUDGET + BUDGET_PER_S)
    now_s += 2.0
    assert budget.left == BUDGET_PER_S
    now_s += 1000.0
    assert budget.left == BUDGET
    budget.block(3.0)
    now_s += 2.9
    assert budget.left < 0
    now_s += 0.2
    assert budget.left > 0


def test_disconnects_a_peer_whose_message_does_not_end(harness: SocketHarness) -> None:
    hostile, honest = harness.deliver(1), harness.deliver(2)
    harness.enforce_limits(0.0)
    for look in range(1, 100):
        harness.socket.num_polls += 1
        harness.deliver(2)
        harness.traffic = dict.fromkeys((1, 2), Traffic(read=20_000 * look))
        harness.enforce_limits(float(look))
    assert hostile.is_disconnected
    assert not honest.is_disconnected


def test_does_not_wake_the_loop_for_an_incomplete_message(harness: SocketHarness) -> None:
    harness.limiter.waker = waker = mock.Mock()
    harness.deliver(1)
    harness.enforce_limits(0.0)
    for read, number in ((300, 0), (400, 1)):
        harness.traffic[1] = Traffic(read=read)
        for look in range(10):
            harness.enforce_limits(10.0 * number + look)
            harness.socket.num_polls += 1  # each time that the loop waits
        assert waker.wake.called
        waker.wake.reset_mock()
        harness.enforce_limits(10.0 * number + 10.0)
        assert not waker.wake.called


def test_sheds_the_owner_with_the_most_undelivered_bytes(harness: SocketHarness) -> None:
    harness.patch.setattr(connection_limits, "MAX_UNDELIVERED_BYTES", 700_000)
    many = [harness.deliver(number, "many") for number in (1, 2, 3)]
    single = harness.deliver(4, "single")
    harness.enforce_limits(0.0)
    harness.traffic = dict.fromkeys((1, 2, 3), Traffic(read=200_000))
    harness.traffic[4] = Traffic(read=300_000)
    harness.enforce_limits(1.0)
    assert len(disconnected(many)) == 1
    assert not single.is_disconnected


def test_peers_that_read_too_little_are_disconnected(harness: SocketHarness) -> None:
    harness.patch.setattr(connection_limits, "MAX_UNREAD_MESSAGES", 3 * MAX_QUEUED)
    silent = [harness.deliver(number, "silent") for number in range(1, 5)]
    other = harness.deliver(5, "other")
    harness.enforce_limits(0.0)
    harness.socket.num_sent += 10 * MAX_QUEUED
    harness.traffic = dict.fromkeys(range(1, 6), Traffic(acknowledged=1000))
    harness.enforce_limits(1.0)
    assert other.unread == 0, "all of them read"
    harness.socket.num_sent += 10 * MAX_QUEUED
    harness.traffic = dict.fromkeys(range(1, 6), Traffic(acknowledged=1000, unsent=1))
    harness.enforce_limits(2.0)
    assert other.unread == MAX_QUEUED, "libzmq drops more"
    assert len(disconnected(silent)) == 2
    assert not other.is_disconnected


@pytest.mark.parametrize("key", ["key", ""])
def test_one_peer_cannot_take_all_connections(harness: SocketHarness, key: str) -> None:
    opened = []
    for number in range(1, 10):
        opened.append(harness.deliver(number, key))
        harness.enforce_limits(0.0)
    assert disconnected(opened) == opened[7:]


def test_clients_cannot_use_connections_of_services_or_other_keys(harness: SocketHarness) -> None:
    honest = [harness.deliver(1, "service"), harness.deliver(2, "laptop")]
    for number in range(10, 40):
        harness.deliver(number, f"flood {number % 2}")
        harness.enforce_limits(0.0)
    honest += [harness.deliver(3, "service"), harness.deliver(4, "laptop")]
    harness.enforce_limits(0.0)
    assert not disconnected(honest)
    assert len(harness.limiter.connections_to(harness.socket)) == 10 + 2


def test_services_can_use_connections_that_clients_do_not_use(harness: SocketHarness) -> None:
    services = [harness.deliver(number, "service") for number in range(20)]
    harness.enforce_limits(0.0)
    assert disconnected(services) == services[15:]
    for number in range(20, 30):
        harness.deliver(number, f"key {number}")
    harness.enforce_limits(0.0)
    assert len(harness.limiter.connections_to(harness.socket)) == 17


def test_surplus_peers_are_disconnected_later(harness: SocketHarness) -> None:
    for number in range(9):
        harness.deliver(number, "key")
    harness.enforce_limits(0.0)
    for time_s, num_closed in ((HOLD_S - 0.1, 0), (HOLD_S, 1), (HOLD_S + GAP_S, 2)):
        harness.enforce_limits(time_s)
        assert sum(held.close.called for held in harness.held.values()) == num_closed


def test_the_oldest_surplus_peers_above_the_capacity_are_reset(harness: SocketHarness) -> None:
    for number in range(7 + 4 * 10 + 1):
        harness.deliver(number, "key")
    harness.enforce_limits(0.0)
    harness.enforce_limits(0.05)
    assert [held.close.called for held in harness.held.values()] == [True] + [False] * 40


def test_an_idle_surplus_peer_can_reconnect_at_once(harness: SocketHarness) -> None:
    harness.addresses = {number: f"10.0.0.{number}" for number in range(20)}
    for number in range(10):
        harness.limiter.find(number, harness.socket)
    for look in range(NUM_NEW_CHECKS):
        harness.enforce_limits(float(look))
    harness.deliver(10, "talker")
    harness.enforce_limits(float(NUM_NEW_CHECKS))
    assert harness.ended == {0}
    assert not harness.held


def test_resets_a_surplus_peer_that_keeps_sending(harness: SocketHarness) -> None:
    for number in range(8):
        harness.deliver(number, "key")
    harness.enforce_limits(0.0)
    harness.ended.clear()  # libzmq still reads
    harness.enforce_limits(0.05)
    assert harness.ended == set(harness.held)


def test_silent_connections_make_room(harness: SocketHarness) -> None:
    harness.addresses = {number: f"10.0.0.{number}" for number in range(20)}
    silent = [harness.limiter.find(number, harness.socket) for number in range(10)]
    talker = harness.deliver(10, "talker")
    harness.enforce_limits(0.0)
    assert disconnected([*silent, talker]) == silent[:1]


@pytest.mark.parametrize(
    ("number", "trims"), [(NUM_ENDED_BEFORE_TRIM - 1, 0), (NUM_ENDED_BEFORE_TRIM, 1)]
)
def test_memory_is_freed_after_many_peers_left(
    harness: SocketHarness, number: int, trims: int
) -> None:
    trim = mock.Mock()
    harness.patch.setattr(connection_limits, "trim_heap", trim)
    for descriptor in range(number):
        harness.deliver(descriptor, f"key {descriptor}")
        harness.ended.add(descriptor)
        harness.enforce_limits(0.0)
    harness.enforce_limits(TRIMS_S[0])
    assert trim.call_count == trims


def test_blocks_a_disconnected_owner_but_keeps_its_other_connections(
    harness: SocketHarness,
) -> None:
    harness.deliver(1, "key").disconnect("test", PENALTY_S)
    harness.enforce_limits(0.0)
    assert harness.limiter.is_blocked("key")
    assert not harness.limiter.is_blocked("other")
    assert list(harness.socket.ended) == [1]
    honest = harness.deliver(2, "key")
    assert not honest.is_disconnected
    assert honest.budget.left >= MIN_BUDGET


def test_a_reused_descriptor_is_another_connection(harness: SocketHarness) -> None:
    before = harness.deliver(1)
    harness.patch.setattr(kernel_sockets, "get_inode", lambda _descriptor: 77)
    assert not harness.limiter.is_open(1)
    assert harness.deliver(1) is not before
    harness.patch.setattr(kernel_sockets, "get_local_port", lambda _descriptor: 80)
    harness.patch.setattr(kernel_sockets, "get_inode", lambda _descriptor: 78)
    assert harness.socket.count_delivery(1, "") is None  # another socket of this process


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
    assert (kernel_sockets.get_network(first) == kernel_sockets.get_network(second)) == is_one


def test_a_process_that_can_open_too_few_files_does_not_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("resource.getrlimit", lambda _: (64, 64))
    with pytest.raises(UserError, match="open files is 64; raise it: ulimit -n 1024"):
        ConnectionLimiter(is_service=lambda _: False)
