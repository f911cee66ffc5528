"""Bounds of connections: hostile ones are cut, honest ones never, however slow."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from kouxing.evaluation.system.attackers import connected, frame
from kouxing.shared import connection, connections, kernel_sockets
from kouxing.shared.bus import COMMANDS, MAX_DROPPED, REFUSAL_COST, Bus, Received, Socket
from kouxing.shared.client import Client
from kouxing.shared.connection import CREDIT, MIB, Connection
from kouxing.shared.connections import MAX_SUBSCRIBED, MAX_SUBSCRIPTION
from kouxing.shared.keys import NOBODY, Peer
from kouxing.shared.wire.audio import AudioChunk
from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.face import FapFrame
from kouxing.shared.wire.message import MAX_AUDIO_BYTES, Message
from kouxing.shared.wire.session import CloseSession, Done, Error
from kouxing.shared.wire.speech import Progress

pytestmark = pytest.mark.unit

LOCAL = "tcp://127.0.0.1:*"
LIMIT_S = 60.0  # for what takes no time on an idle machine


@pytest.fixture
def bus() -> Iterator[Bus]:
    with Bus() as made:
        yield made


def port_of(bound: Socket) -> int:
    return int(bound.endpoint.rpartition(":")[2])


def collect(bus: Bus, bound: Socket, is_enough: Callable[[list[Received]], bool]) -> list[Received]:
    """Receive as a service's loop does, until it is enough."""
    received: list[Received] = []
    poller, end_s = bus.poller(), time.monotonic() + 30
    poller.add(bound)
    while not is_enough(received):
        assert time.monotonic() < end_s
        for ready in poller.wait(0.01):
            received += ready.receive()
    return received


def chunk(sequence: int, num_bytes: int = MAX_AUDIO_BYTES, session: str = "s") -> Message:
    return AudioChunk(session=session, token="t", sequence=sequence, pcm=bytes(num_bytes))


def wire_bytes(message: Message) -> bytes:
    topic, body = encode(message)
    return frame(topic, more=True) + frame(body)


def test_many_fast_senders_wait_while_nothing_is_received(bus: Bus) -> None:
    audio = bus.bind_router(LOCAL, "audio")
    senders = [bus.connect_dealer(audio.endpoint) for _ in range(16)]
    num_chunks = 30
    for name, sender in enumerate(senders):
        for number in range(num_chunks):
            assert sender.send(chunk(number, session=str(name)))
    time.sleep(0.5)  # as when a service pauses a socket
    received = collect(bus, audio, lambda all_: len(all_) == len(senders) * num_chunks)
    numbers: dict[str, list[int]] = {}
    for each in received:
        assert isinstance(each.message, Message)
        numbers.setdefault(each.message.session, []).append(each.message.sequence)
    assert numbers == {str(name): [*range(num_chunks)] for name in range(len(senders))}


@pytest.mark.parametrize("is_late", [(True, False), (False, True)], ids=["before", "after"])
def test_a_fast_sender_stays_while_the_guard_is_not_given_the_processor(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, is_late: tuple[bool, bool]
) -> None:
    figure = kernel_sockets.tcp_figure

    def late_figure(descriptor: int, offset: int) -> int:
        time.sleep(0.1 * is_late[0])
        found = figure(descriptor, offset)
        time.sleep(0.1 * is_late[1])
        return found

    monkeypatch.setattr(kernel_sockets, "tcp_figure", late_figure)
    audio = bus.bind_router(LOCAL, "audio")
    sender = bus.connect_dealer(audio.endpoint)
    chunks = [chunk(number, 20_000) for number in range(500)]
    received: list[Received] = []
    for each in chunks:
        assert sender.send(each)
        time.sleep(0.001)
        received += audio.receive()
    received += collect(bus, audio, lambda all_: len(received) + len(all_) == len(chunks))
    assert [each.message for each in received] == chunks
    assert len({each.sender.connection for each in received}) == 1


def test_a_message_that_comes_in_pieces_arrives(bus: Bus) -> None:
    audio = bus.bind_router(LOCAL, "audio")
    data = wire_bytes(chunk(1))
    taken: list[Received] = []
    with connected(port_of(audio)) as slow:
        other = bus.connect_dealer(audio.endpoint)
        for begin in range(0, len(data), len(data) // 4):
            slow.sendall(data[begin : begin + len(data) // 4])
            for number in range(20):  # others' messages are delivered meanwhile
                other.send(Progress(sequence=number, level_db=0.0))
                time.sleep(0.005)
                taken += audio.receive()
        slow.sendall(wire_bytes(chunk(2, 10)))
        taken += collect(bus, audio, lambda all_: chunk(2, 10) in [r.message for r in all_])
    assert chunk(1) in [each.message for each in taken]


def test_a_subscriber_may_follow_one_session_after_another_for_hours(bus: Bus) -> None:
    faps = bus.bind_publisher(LOCAL, "faps")
    num_topics = MAX_SUBSCRIBED // MAX_SUBSCRIPTION + 100
    with connected(port_of(faps), "SUB") as subscriber:
        for number in range(num_topics):
            topic = str(number).rjust(MAX_SUBSCRIPTION, "x").encode()
            subscriber.sendall(frame(b"\x01" + topic) + frame(b"\x00" + topic))
            time.sleep(0.001)
            list(faps.receive())
        subscriber.sendall(frame(b"\x01fap-frame/") + frame(b"\x01joined/s/"))
        subscriber.settimeout(0.002)
        answer, end_s = b"", time.monotonic() + 20
        while b"joined/s/" not in answer:
            assert time.monotonic() < end_s
            list(faps.receive())
            try:
                answer += subscriber.recv(1000)
            except TimeoutError:
                continue


def test_one_that_subscribes_to_too_much_is_cut(bus: Bus) -> None:
    faps = bus.bind_publisher(LOCAL, "faps")
    honest = bus.connect_subscriber(faps.endpoint)
    honest.subscribe(FapFrame, "s")
    with connected(port_of(faps), "SUB") as hostile:
        for number in range(MAX_SUBSCRIBED // MAX_SUBSCRIPTION):
            hostile.sendall(frame(b"\x01" + str(number).rjust(MAX_SUBSCRIPTION, "x").encode()))
        assert not is_cut(hostile, faps, num_looks=20)
        hostile.sendall(frame(b"\x01x"))
        assert is_cut(hostile, faps)
    with connected(port_of(faps), "SUB") as hostile:
        hostile.sendall(frame(b"\x01" + bytes(MAX_SUBSCRIPTION + 1)))
        assert is_cut(hostile, faps)
    frame_ = FapFrame(session="s", values=b"\0" * 272, mask=b"\0" * 9)
    faps.send(frame_)
    assert honest.wait(20.0)


def is_cut(connection: socket.socket, bound: Socket, num_looks: int = 500) -> bool:
    """Whether a connection ends soon, while its other end's messages are received."""
    for _ in range(num_looks):
        list(bound.receive())
        if has_ended(connection):
            return True
    return False


def has_ended(connection: socket.socket) -> bool:
    """Whether a connection ends now."""
    connection.settimeout(0.02)
    try:
        return not connection.recv(65_536)
    except TimeoutError:
        return False
    except OSError:
        return True


def test_the_first_connection_is_watched_at_once(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "SWEEP_S", 1000.0)
    phones = bus.bind_router(LOCAL, "phones")
    with connected(port_of(phones)) as hostile:
        for _ in range(2000):
            try:
                hostile.sendall(frame(b"", more=True) * 1000)
            except ConnectionError:
                return
            list(phones.receive())
            time.sleep(0.002)
    raise AssertionError("it was not cut")


def test_what_comes_while_the_guard_sleeps_is_seen_later(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "LOOK_S", 0.3)
    monkeypatch.setattr(connections, "NEAR_S", 0.0)
    phones = bus.bind_router(LOCAL, "phones")
    with connected(port_of(phones)) as hostile:
        assert not is_cut(hostile, phones, num_looks=30)
        hostile.sendall(frame(b"", more=True))  # wakes it
        time.sleep(0.1)
        hostile.sendall(frame(b"", more=True) * 50_000)
        assert is_cut(hostile, phones)


def test_one_whose_message_does_not_end_is_cut_though_little_waits(bus: Bus) -> None:
    phones = bus.bind_router(LOCAL, "phones")
    with connected(port_of(phones)) as hostile:
        hostile.sendall(frame(b"", more=True) * 50_000)
        assert is_cut(hostile, phones)


def test_one_that_sends_only_what_is_refused_is_cut(bus: Bus) -> None:
    audio = bus.bind_router(LOCAL, "audio")
    with connected(port_of(audio)) as hostile:
        hostile.settimeout(0.001)
        bad = 10 * (frame(b"nothing/s/", more=True) + frame(b"\x80"))  # credit comes back meanwhile
        unsent = bad
        end_s = time.monotonic() + LIMIT_S
        while time.monotonic() < end_s:
            try:
                unsent = unsent[hostile.send(unsent) :] or bad
            except TimeoutError:
                pass
            except OSError:
                return
            for received in audio.receive():
                audio.send(Error(code="bad-message", text="no"), to=received.sender)
    raise AssertionError("it was not cut")


def test_one_that_takes_nothing_is_cut_once_too_much_waits(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "MAX_UNREAD", MIB)
    faps = bus.bind_publisher(LOCAL, "faps")
    honest = bus.connect_subscriber(faps.endpoint)
    honest.subscribe(FapFrame, "s")
    with connected(port_of(faps), "SUB") as silent:
        silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        silent.sendall(frame(b"\x01fap-frame/"))
        send_until_cut(silent, faps, NOBODY, honest)


def test_one_that_takes_no_answers_is_cut_once_too_much_waits(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "MAX_UNREAD", MIB)
    commands = bus.bind_router(LOCAL, "commands", COMMANDS)
    with connected(port_of(commands)) as silent:
        silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        silent.sendall(wire_bytes(Progress(level_db=0.0)))
        (received,) = collect(bus, commands, lambda all_: len(all_) == 1)
        send_until_cut(silent, commands, received.sender)


def send_until_cut(silent: socket.socket, bound: Socket, peer: Peer, *honest: Socket) -> None:
    """Send to one that takes nothing; others get all."""
    ends = select.poll()
    ends.register(silent, 0)
    num_sent, num_taken, end_s = 0, 0, time.monotonic() + 30
    while not ends.poll(5):
        assert time.monotonic() < end_s
        list(bound.receive())
        for _ in range(100 if num_sent < 15_000 else 0):  # ZeroMQ itself drops more than 20 000
            bound.send(FapFrame(session="s", values=bytes(272), mask=bytes(9)), to=peer)
            num_sent += 1
        num_taken += sum(len(list(each.receive())) for each in honest)
    while honest and num_taken < num_sent - 300:  # before it had subscribed
        assert honest[0].wait(5.0)
        num_taken += len(list(honest[0].receive()))


def test_a_message_of_another_connection_has_another_number(bus: Bus) -> None:
    audio = bus.bind_router(LOCAL, "audio")
    port = port_of(audio)
    with connected(port) as first, connected(port) as second:
        numbers = []
        for sequence, connection in enumerate((first, second, first, second)):
            connection.sendall(wire_bytes(chunk(sequence, 10)))
            (received,) = collect(bus, audio, lambda all_: len(all_) == 1)
            numbers.append(received.sender.connection)
    assert numbers[:2] == numbers[2:]
    assert len({*numbers, 0}) == 3


def test_the_end_of_a_connection_is_told_by_its_number(bus: Bus) -> None:
    audio = bus.bind_router(LOCAL, "audio")
    port = port_of(audio)
    with connected(port) as lasting:
        for _ in range(3):  # a descriptor is used again
            with connected(port) as connection:
                connection.sendall(wire_bytes(chunk(1, 10)))
                (received,) = collect(bus, audio, lambda all_: len(all_) == 1)
                assert not list(audio.ended())
            end_s = time.monotonic() + 20
            ended: list[int] = []
            while not ended and time.monotonic() < end_s:
                ended = list(audio.ended())
            assert ended == [received.sender.connection]
        lasting.sendall(wire_bytes(chunk(1, 10)))
        assert collect(bus, audio, lambda all_: len(all_) == 1)


def test_a_descriptor_that_is_used_again_is_not_cut() -> None:
    before, other = socket.socketpair()
    gone = Connection(before.fileno(), os.fstat(before.fileno()).st_ino)
    descriptor = before.detach()
    left, right = socket.socketpair()
    with left, right, other:
        os.dup2(left.fileno(), descriptor)
        gone.cut("it has gone")
        right.sendall(b"still there")
        assert left.recv(20) == b"still there"
        assert not gone.exists()
        os.close(descriptor)


def test_what_a_reused_descriptor_brings_counts_against_nobody(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connections, "SWEEP_S", 0.02)
    audio = bus.bind_router(LOCAL, "audio")
    for _ in range(3):
        with socket.create_server(("127.0.0.1", 0)) as server:
            left = socket.create_connection(server.getsockname())
            right, _ = server.accept()
        descriptors = sockets()
        with connected(port_of(audio)) as client:
            client.sendall(wire_bytes(chunk(1, 10)))
            collect(bus, audio, lambda all_: len(all_) == 1)
            (descriptor,) = sockets() - descriptors - {client.fileno()}
        end_s = time.monotonic() + 20
        while is_socket(descriptor):
            assert time.monotonic() < end_s
            time.sleep(0.001)
        with left, right:
            os.dup2(left.fileno(), descriptor)
            for _ in range(20):
                right.sendall(bytes(20_000))
                left.recv(20_000, socket.MSG_WAITALL)
                list(audio.receive())
                time.sleep(0.01)
            os.close(descriptor)
    assert "cut a connection" not in caplog.text


def sockets() -> set[int]:
    """The descriptors of this process that are sockets."""
    descriptors = [int(each.name) for each in Path("/proc/self/fd").iterdir()]
    return {each for each in descriptors if is_socket(each)}


def is_socket(descriptor: int) -> bool:
    try:
        return stat.S_ISSOCK(os.fstat(descriptor).st_mode)
    except OSError:
        return False


def test_silent_connections_make_room_for_new_ones(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 40)
    audio = bus.bind_router(LOCAL, "audio")
    talker = bus.connect_dealer(audio.endpoint)
    talker.send(chunk(1, 10))
    collect(bus, audio, lambda all_: len(all_) == 1)
    silent = [connected(port_of(audio)) for _ in range(60)]
    late = bus.connect_dealer(audio.endpoint)
    late.send(chunk(2, 10))
    collect(bus, audio, lambda all_: len(all_) == 1)
    talker.send(chunk(3, 10))
    collect(bus, audio, lambda all_: late.send(chunk(3, 10)) and bool(all_))
    assert all(is_cut(each, audio) for each in silent[: 60 - 40])
    for each in silent:
        each.close()


def test_an_address_that_floods_once_is_shut_out_for_a_while(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "FAULTS_S", 0)
    audio = bus.bind_router(LOCAL, "audio")
    talker = bus.connect_dealer(audio.endpoint)
    talker.send(chunk(1, 10))
    collect(bus, audio, lambda all_: len(all_) == 1)
    with connected(port_of(audio)) as hostile:
        hostile.sendall(frame(b"", more=True) * 2 * MAX_DROPPED + frame(b""))
        assert is_cut(hostile, audio)
    for host in ("127.0.0.1", "127.0.0.9"):  # all of them are one
        with contextlib.suppress(ConnectionError), connected(port_of(audio), host=host) as other:
            assert is_cut(other, audio, num_looks=50)
    late = bus.connect_dealer(audio.endpoint)
    for sequence in range(10, 20):  # its connection stays
        time.sleep(0.02)
        talker.send(chunk(sequence, 10))
        received = collect(bus, audio, lambda all_: len(all_) >= 1)
        assert received[-1].message == chunk(sequence, 10)
    monkeypatch.setattr(connections, "FAULTS_S", 50)
    collect(bus, audio, lambda all_: late.send(chunk(3, 10)) and bool(all_))


def test_a_client_whose_address_is_shut_out_for_a_while_gets_its_answer(bus: Bus) -> None:
    commands = bus.bind_router(LOCAL, "commands", COMMANDS)
    with connected(port_of(commands)) as hostile:
        hostile.sendall(frame(b"", more=True) * 2 * MAX_DROPPED + frame(b""))
        assert is_cut(hostile, commands)
    with Client(commands.endpoint) as client, ThreadPoolExecutor(1) as pool:
        closing = pool.submit(client.close_session, "s", "t")
        (request, *_) = collect(bus, commands, bool)
        assert isinstance(request.message, CloseSession)
        commands.send(Done(session="s", request=request.message.request), to=request.sender)
        closing.result()


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


@pytest.mark.parametrize("kind", ["DEALER", "SUB"])
def test_a_message_of_very_many_parts_is_given_up_little_by_little(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    for name in ("NEAR_LOOK_S", "LOOK_S"):  # the guard comes too late
        monkeypatch.setattr(connections, name, 2.0)
    bound = (bus.bind_router if kind == "DEALER" else bus.bind_publisher)(LOCAL, "bound")
    with connected(port_of(bound), kind) as hostile:
        num_parts = 20 * MAX_DROPPED
        hostile.sendall(frame(b"", more=True) * num_parts + frame(b""))
        assert bound.wait(20.0)
        guarded = bound._guarded
        assert guarded is not None
        turns, before = 0, guarded.turns
        while bound.wait(0.0):
            assert guarded.turns == before  # whose message was not delivered yet is not judged
            list(bound.receive())
            turns += 1
    assert turns >= num_parts // MAX_DROPPED


def test_who_comes_again_has_no_more_credit_than_before(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "CREDIT_S", 0.0)
    audio = bus.bind_router(LOCAL, "audio")
    bad = frame(b"nothing/s/", more=True) + frame(b"\x80")
    num_refused = 0
    for _ in range(4):
        with connected(port_of(audio)) as hostile:
            hostile.sendall(bad * 500)
            num_left = 500
            while num_left and not has_ended(hostile):
                for received in audio.receive():
                    audio.send(Error(code="bad-message", text="no"), to=received.sender)
                    num_left -= 1
                    num_refused += 1
        end_s = time.monotonic() + 20
        while not list(audio.ended()) and time.monotonic() < end_s:
            list(audio.receive())
    assert num_refused < CREDIT / REFUSAL_COST + 10


def test_nobody_pays_for_what_waits_of_a_connection_that_is_cut(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "CREDIT_S", 0.0)
    commands = bus.bind_router(LOCAL, "commands", COMMANDS)
    with connected(port_of(commands)) as hostile:
        hostile.sendall(frame(b"x") * round(2 * CREDIT / COMMANDS.cost))
        while not has_ended(hostile):
            list(commands.receive())
    while bus._guard.num_connections:
        list(commands.receive())
    assert bus._guard._credits["loopback"].left > -2 * COMMANDS.cost
