"""Limits of connections over real sockets: hostile peers are disconnected, honest ones never."""

import contextlib
import socket
import time
from collections.abc import Callable, Iterator

import pytest
from kouxing_client.field_types import MAX_AUDIO_BYTES
from kouxing_client.messages import EndOfFaps, FapFrame, Message

from kouxing.shared.network import connection_limits, peer_quota, sockets, tarpit
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.connection_limits import (
    MAX_SUBSCRIPTION_BYTES,
    MAX_TOPICS_BYTES,
    ConnectionLimiter,
)
from kouxing.shared.network.sockets import MAX_DROPPED, Poller, ReceivedMessage, Socket
from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.session import AudioChunk
from kouxing.shared.wire.speech import Progress
from tests.raw_bytes import connect_raw, frame
from tests.samples import fap_frame
from tests.system import LIMIT_S, wait_until

LOCAL = "tcp://127.0.0.1:*"


@pytest.fixture
def bus() -> Iterator[Bus]:
    with Bus() as new_bus:
        yield new_bus


def port_of(bound: Socket) -> int:
    return int(bound.endpoint.rpartition(":")[2])


def receive_until(
    bus: Bus, bound: Socket, is_enough: Callable[[list[ReceivedMessage]], bool]
) -> list[ReceivedMessage]:
    """Receive as a service's loop does, until it is enough."""
    received: list[ReceivedMessage] = []
    poller = Poller()
    poller.add(bound)

    def has_enough() -> bool:
        for ready in poller.wait(0.01):
            received.extend(ready.receive())
        return is_enough(received)

    wait_until(has_enough)
    return received


def chunk(sequence: int, num_bytes: int = MAX_AUDIO_BYTES, session: str = "s") -> Message:
    return AudioChunk(session=session, token="t", sequence=sequence, pcm=bytes(num_bytes))


def wire_bytes(message: Message) -> bytes:
    topic, body = encode(message)
    return frame(topic, more=True) + frame(body)


def test_fast_senders_wait_while_nothing_is_received(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks: list[float] = []
    enforce_limits = ConnectionLimiter.enforce_limits

    def count_and_enforce(limiter: ConnectionLimiter, now_s: float) -> None:
        enforce_limits(limiter, now_s)
        checks.append(now_s)

    monkeypatch.setattr(ConnectionLimiter, "enforce_limits", count_and_enforce)
    audio = bus.bind_router(LOCAL, "audio")
    senders = [bus.connect_dealer(audio.endpoint) for _ in range(16)]
    num_chunks = 30
    for name, sender in enumerate(senders):
        for number in range(num_chunks):
            assert sender.send(chunk(number, session=str(name)))
    num_before = len(checks)
    wait_until(lambda: len(checks) > num_before + 20)  # a service may pause a socket
    received = receive_until(bus, audio, lambda all_: len(all_) == len(senders) * num_chunks)
    numbers: dict[str, list[int]] = {}
    for item in received:
        assert isinstance(item.message, Message)
        numbers.setdefault(item.message.session, []).append(item.message.sequence)
    assert numbers == {str(name): [*range(num_chunks)] for name in range(len(senders))}


def test_a_message_may_arrive_in_pieces(bus: Bus) -> None:
    audio = bus.bind_router(LOCAL, "audio")
    data = wire_bytes(chunk(1))
    handled: list[ReceivedMessage] = []
    with connect_raw(port_of(audio)) as slow:
        other = bus.connect_dealer(audio.endpoint)
        for begin in range(0, len(data), len(data) // 4):
            slow.sendall(data[begin : begin + len(data) // 4])
            for number in range(20):  # other messages are delivered in between
                other.send(Progress(sequence=number, level_db=0.0))
                time.sleep(0.005)
                handled += audio.receive()
        slow.sendall(wire_bytes(chunk(2, 10)))
        handled += receive_until(bus, audio, lambda all_: chunk(2, 10) in [r.message for r in all_])
    assert chunk(1) in [item.message for item in handled]


def test_a_subscriber_may_follow_many_sessions_in_sequence(bus: Bus) -> None:
    faps = bus.bind_publisher(LOCAL, "faps")
    num_topics = MAX_TOPICS_BYTES // MAX_SUBSCRIPTION_BYTES + 100
    with connect_raw(port_of(faps), "SUB") as subscriber:
        for number in range(num_topics):
            topic = str(number).rjust(MAX_SUBSCRIPTION_BYTES, "x").encode()
            subscriber.sendall(frame(b"\x01" + topic) + frame(b"\x00" + topic))
            time.sleep(0.001)
            list(faps.receive())
        subscriber.sendall(frame(b"\x01fap-frame/") + frame(b"\x01joined/s/"))
        subscriber.settimeout(0.002)
        answer = bytearray()

        def has_joined() -> bool:
            list(faps.receive())
            with contextlib.suppress(TimeoutError):
                answer.extend(subscriber.recv(1000))
            return b"joined/s/" in answer

        wait_until(has_joined)


def test_ended_subscriptions_do_not_make_a_publisher_encode_every_message(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sockets, "MAX_SUBSCRIPTIONS", 8)
    faps = bus.bind_publisher(LOCAL, "faps")
    limited = faps._limited
    assert limited is not None
    with connect_raw(port_of(faps), "SUB") as subscriber:
        subscriber.sendall(frame(b"\x01fap-frame/kept/") + frame(b"\x01end-of-faps/"))
        for number in range(20):
            topic = f"fap-frame/{number}/".encode()
            subscriber.sendall(frame(b"\x01" + topic) + frame(b"\x00" + topic))
        subscriber.sendall(frame(b"\x01joined/s/"))
        wait_until(lambda: limited.num_sent == 1, step=lambda: [*faps.receive()])
        faps.send(fap_frame("nobody", 0, bytes(272)))
        assert limited.num_sent == 1
        faps.send(fap_frame("kept", 0, bytes(272)))
        faps.send(EndOfFaps(session="any", epoch=1))
        assert limited.num_sent == 3


def test_disconnects_a_peer_with_too_many_subscriptions(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_limits, "PENALTY_S", 0.0)
    faps = bus.bind_publisher(LOCAL, "faps")
    honest = bus.connect_subscriber(faps.endpoint)
    honest.subscribe(FapFrame, "s")
    with connect_raw(port_of(faps), "SUB") as hostile:
        for number in range(MAX_TOPICS_BYTES // MAX_SUBSCRIPTION_BYTES):
            hostile.sendall(
                frame(b"\x01" + str(number).rjust(MAX_SUBSCRIPTION_BYTES, "x").encode())
            )
        assert not is_soon_disconnected(hostile, faps, num_checks=20)
        hostile.sendall(frame(b"\x01x"))
        assert is_soon_disconnected(hostile, faps)
    with connect_raw(port_of(faps), "SUB") as hostile:
        hostile.sendall(frame(b"\x01" + bytes(MAX_SUBSCRIPTION_BYTES + 1)))
        assert is_soon_disconnected(hostile, faps)
    frame_ = FapFrame(session="s", packed_values=b"\0" * 272, mask=b"\0" * 9)
    faps.send(frame_)
    assert honest.wait(LIMIT_S)


def test_surplus_peers_do_not_reconnect_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer_quota, "MAX_CONNECTIONS", 4)
    monkeypatch.setattr(connection_limits, "NUM_NEW_CHECKS", 10**6)
    monkeypatch.setattr(tarpit, "HOLD_S", 600.0)
    with contextlib.ExitStack() as stack:
        with Bus() as bus:
            audio = bus.bind_router(LOCAL, "audio")
            peers = [stack.enter_context(connect_raw(port_of(audio))) for _ in range(6)]
            wait_until(lambda: len(bus._limiter) == 3)  # three quarters for one address
            assert not any(has_ended(peer) for peer in peers)
        wait_until(lambda: all(has_ended(peer) for peer in peers))


def is_soon_disconnected(connection: socket.socket, bound: Socket, num_checks: int = 5000) -> bool:
    """Whether a connection ends soon, while its other end's messages are received."""
    for _ in range(num_checks):
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


def test_a_message_of_very_many_parts_is_dropped_step_by_step(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_limits, "CHECK_INTERVAL_S", 600.0)  # the limiter acts too late
    bound = bus.bind_router(LOCAL, "bound")
    with connect_raw(port_of(bound)) as hostile:
        num_parts = 20 * MAX_DROPPED
        hostile.sendall(frame(b"", more=True) * num_parts + frame(b""))
        assert bound.wait(LIMIT_S)
        turns = 0
        while bound.wait(0.0):
            list(bound.receive())
            turns += 1
    assert turns >= num_parts // MAX_DROPPED
