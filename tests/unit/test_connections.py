"""Decisions about connections, without sockets: who is disconnected, and who never."""

from types import SimpleNamespace
from typing import cast
from unittest import mock

import pytest

from kouxing.shared import connections, kernel_sockets, peer_quota
from kouxing.shared.budget import BUDGET, BUDGET_PER_S, MIN_BUDGET, Budget
from kouxing.shared.bus import AUDIO
from kouxing.shared.connections import (
    MAX_QUEUED,
    NEW_CHECKS,
    NUM_ENDED_BEFORE_TRIM,
    PENALTY_S,
    TRIMS_S,
    Connection,
    ConnectionLimiter,
)
from kouxing.shared.kernel_sockets import Traffic
from kouxing.shared.tarpit import GAP_S, HOLD_S


class Scene:
    """A bound socket for audio; descriptor and inode of a connection are the same number."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.patch = patch
        self.addresses: dict[int, str] = {}
        self.traffic: dict[int, Traffic] = {}
        self.ended: set[int] = set()
        self.held: dict[int, mock.Mock] = {}
        patch.setattr(kernel_sockets, "inode_of", lambda d: None if d in self.ended else d)
        patch.setattr(kernel_sockets, "reset", lambda d, _inode: self.ended.add(d))
        patch.setattr(kernel_sockets, "hold", self.hold)
        patch.setattr(kernel_sockets, "port_of", lambda _descriptor: 5560)
        patch.setattr(kernel_sockets, "address_of", lambda d: self.addresses.get(d, "loopback"))
        patch.setattr(kernel_sockets, "traffic_of", lambda d: self.traffic.get(d, Traffic()))
        patch.setattr(peer_quota, "MAX_CONNECTIONS", 10)
        patch.setattr("threading.Thread.start", lambda _thread: None)
        self.limiter = ConnectionLimiter(is_service=lambda key: key == "service")
        monitor = SimpleNamespace(getsockopt=lambda _option: 10**6)
        raw = SimpleNamespace(setsockopt=lambda *_: None, get_monitor_socket=lambda *_: monitor)
        self.socket = self.limiter.limit(raw, AUDIO)  # type: ignore[arg-type]
        self.socket.port = 5560
        self.socket.accepted = lambda: iter(())  # type: ignore[method-assign]
        self.enforce_limits = self.limiter.enforce_limits

    def hold(self, descriptor: int, _inode: int) -> mock.Mock:
        self.ended.add(descriptor)
        self.held[descriptor] = mock.Mock()
        return self.held[descriptor]

    def deliver(self, descriptor: int, key: str = "") -> Connection:
        return cast(Connection, self.socket.deliver(descriptor, key))


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    return Scene(monkeypatch)


def test_a_budget_recovers_and_a_blocked_one_recovers_later() -> None:
    now_s = 100.0
    budget = Budget(clock=lambda: now_s)
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


def test_disconnects_a_peer_whose_message_does_not_end(scene: Scene) -> None:
    hostile, honest = scene.deliver(1), scene.deliver(2)
    scene.enforce_limits(0.0)
    for look in range(1, 100):
        scene.socket.num_polls += 1
        scene.deliver(2)
        scene.traffic = dict.fromkeys((1, 2), Traffic(read=20_000 * look))
        scene.enforce_limits(float(look))
    assert hostile.is_disconnected
    assert not honest.is_disconnected


def test_does_not_wake_the_loop_for_an_incomplete_message(scene: Scene) -> None:
    scene.limiter.waker = waker = mock.Mock()
    scene.deliver(1)
    scene.enforce_limits(0.0)
    for read, number in ((300, 0), (400, 1)):
        scene.traffic[1] = Traffic(read=read)
        for look in range(10):
            scene.enforce_limits(10.0 * number + look)
            scene.socket.num_polls += 1  # each time that the loop waits
        assert waker.wake.called
        waker.wake.reset_mock()
        scene.enforce_limits(10.0 * number + 10.0)
        assert not waker.wake.called


def test_sheds_the_owner_with_the_most_undelivered_bytes(scene: Scene) -> None:
    scene.patch.setattr(connections, "MAX_UNDELIVERED", 700_000)
    many = [scene.deliver(number, "many") for number in (1, 2, 3)]
    single = scene.deliver(4, "single")
    scene.enforce_limits(0.0)
    scene.traffic = dict.fromkeys((1, 2, 3), Traffic(read=200_000))
    scene.traffic[4] = Traffic(read=300_000)
    scene.enforce_limits(1.0)
    assert sum(connection.is_disconnected for connection in many) == 1
    assert not single.is_disconnected


def test_disconnects_those_that_read_too_little(scene: Scene) -> None:
    scene.patch.setattr(connections, "MAX_UNREAD", 3 * MAX_QUEUED)
    silent = [scene.deliver(number, "silent") for number in range(1, 5)]
    other = scene.deliver(5, "other")
    scene.enforce_limits(0.0)
    scene.socket.num_sent += 10 * MAX_QUEUED
    scene.traffic = dict.fromkeys(range(1, 6), Traffic(acknowledged=1000))
    scene.enforce_limits(1.0)
    assert other.unread == 0, "all of them read"
    scene.socket.num_sent += 10 * MAX_QUEUED
    scene.traffic = dict.fromkeys(range(1, 6), Traffic(acknowledged=1000, unsent=1))
    scene.enforce_limits(2.0)
    assert other.unread == MAX_QUEUED, "libzmq drops more"
    assert sum(connection.is_disconnected for connection in silent) == 2
    assert not other.is_disconnected


@pytest.mark.parametrize("key", ["key", ""])
def test_one_peer_cannot_take_all_connections(scene: Scene, key: str) -> None:
    made = []
    for number in range(1, 10):
        made.append(scene.deliver(number, key))
        scene.enforce_limits(0.0)
    assert [connection.is_disconnected for connection in made] == [False] * 7 + [True] * 2


def test_clients_cannot_use_connections_of_services_or_other_keys(scene: Scene) -> None:
    honest = [scene.deliver(1, "service"), scene.deliver(2, "laptop")]
    for number in range(10, 40):
        scene.deliver(number, f"flood {number % 2}")
        scene.enforce_limits(0.0)
    honest += [scene.deliver(3, "service"), scene.deliver(4, "laptop")]
    scene.enforce_limits(0.0)
    assert not any(connection.is_disconnected for connection in honest)
    assert len(scene.limiter.connections_to(scene.socket)) == 10 + 2


def test_services_can_use_connections_that_clients_do_not_use(scene: Scene) -> None:
    services = [scene.deliver(number, "service") for number in range(20)]
    scene.enforce_limits(0.0)
    assert [connection.is_disconnected for connection in services] == [False] * 15 + [True] * 5
    for number in range(20, 30):
        scene.deliver(number, f"key {number}")
    scene.enforce_limits(0.0)
    assert len(scene.limiter.connections_to(scene.socket)) == 17


def test_surplus_peers_are_disconnected_later(scene: Scene) -> None:
    for number in range(9):
        scene.deliver(number, "key")
    scene.enforce_limits(0.0)
    for time_s, num_closed in ((HOLD_S - 0.1, 0), (HOLD_S, 1), (HOLD_S + GAP_S, 2)):
        scene.enforce_limits(time_s)
        assert sum(held.close.called for held in scene.held.values()) == num_closed


def test_resets_the_oldest_surplus_peers_above_the_capacity(scene: Scene) -> None:
    for number in range(7 + 4 * 10 + 1):
        scene.deliver(number, "key")
    scene.enforce_limits(0.0)
    scene.enforce_limits(0.05)
    assert [held.close.called for held in scene.held.values()] == [True] + [False] * 40


def test_an_idle_surplus_peer_can_reconnect_at_once(scene: Scene) -> None:
    scene.addresses = {number: f"10.0.0.{number}" for number in range(20)}
    for number in range(10):
        scene.limiter.find(number, scene.socket)
    for look in range(NEW_CHECKS):
        scene.enforce_limits(float(look))
    scene.deliver(10, "talker")
    scene.enforce_limits(float(NEW_CHECKS))
    assert scene.ended == {0}
    assert not scene.held


def test_resets_a_surplus_peer_that_keeps_sending(scene: Scene) -> None:
    for number in range(8):
        scene.deliver(number, "key")
    scene.enforce_limits(0.0)
    scene.ended.clear()  # libzmq still reads
    scene.enforce_limits(0.05)
    assert scene.ended == set(scene.held)


def test_silent_connections_make_room(scene: Scene) -> None:
    scene.addresses = {number: f"10.0.0.{number}" for number in range(20)}
    silent = [scene.limiter.find(number, scene.socket) for number in range(10)]
    talker = scene.deliver(10, "talker")
    scene.enforce_limits(0.0)
    assert [connection.is_disconnected for connection in silent if connection] == [True] + [
        False
    ] * 9
    assert not talker.is_disconnected


@pytest.mark.parametrize(
    ("number", "trims"), [(NUM_ENDED_BEFORE_TRIM - 1, 0), (NUM_ENDED_BEFORE_TRIM, 1)]
)
def test_gives_memory_back_after_many_peers_left(scene: Scene, number: int, trims: int) -> None:
    trim = mock.Mock()
    scene.patch.setattr(connections, "trim_heap", trim)
    for descriptor in range(number):
        scene.deliver(descriptor, f"key {descriptor}")
        scene.ended.add(descriptor)
        scene.enforce_limits(0.0)
    scene.enforce_limits(TRIMS_S[0])
    assert trim.call_count == trims


def test_blocks_a_disconnected_owner_but_keeps_its_other_connections(scene: Scene) -> None:
    scene.deliver(1, "key").disconnect("test", PENALTY_S)
    scene.enforce_limits(0.0)
    assert scene.limiter.is_blocked("key")
    assert not scene.limiter.is_blocked("other")
    assert list(scene.socket.ended) == [1]
    honest = scene.deliver(2, "key")
    assert not honest.is_disconnected
    assert honest.budget.left >= MIN_BUDGET


def test_a_reused_descriptor_is_another_connection(scene: Scene) -> None:
    before = scene.deliver(1)
    scene.patch.setattr(kernel_sockets, "inode_of", lambda _descriptor: 77)
    assert not scene.limiter.is_open(1)
    assert scene.deliver(1) is not before
    scene.patch.setattr(kernel_sockets, "port_of", lambda _descriptor: 80)
    scene.patch.setattr(kernel_sockets, "inode_of", lambda _descriptor: 78)
    assert scene.socket.deliver(1, "") is None  # another socket of this process


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
