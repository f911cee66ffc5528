"""A client's session over real sockets, with control and recognizers played by the test."""

from __future__ import annotations

import dataclasses
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
import pytest

from kouxing.shared import client as client_module
from kouxing.shared.bus import Bus, Socket
from kouxing.shared.client import NEAREST_MS, RESEND_S, Client, Session
from kouxing.shared.keys import Peer
from kouxing.shared.wire.audio import AcknowledgeAudio, AudioChunk
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    ErrorCode,
    FlushSession,
    OpenSession,
    SessionFacts,
    SessionMoved,
    SessionOpened,
)
from kouxing.shared.wire.speech import Phone
from tests.raw_bytes import answer_handshake

pytestmark = pytest.mark.unit
LOCAL = "tcp://127.0.0.1:*"
CHUNK = np.zeros(1600, np.int16)  # 100 ms
M = TypeVar("M", bound=Message)


def next_of(kind: type[M], socket: Socket) -> tuple[M, Peer]:
    """Return the next message, which must be of a kind, and its sender."""
    assert socket.wait(5.0)
    received = next(socket.receive())
    assert isinstance(received.message, kind)
    return received.message, received.sender


class Stage:
    """Control, two recognizers' sockets, and a client with one open session."""

    def __init__(self) -> None:
        self.bus = Bus()
        self.commands = self.bus.bind_router(LOCAL, "commands")
        self.audio = [self.bus.bind_router(LOCAL, "audio") for _ in range(2)]
        self.phones = [self.bus.bind_publisher(LOCAL, "phones") for _ in range(2)]
        self.client = Client(self.commands.endpoint)
        with ThreadPoolExecutor(1) as pool:
            opening = pool.submit(self.client.open_session)
            request, self.address = next_of(OpenSession, self.commands)
            self.opened = SessionOpened(
                session="s",
                epoch=1,
                request=request.request,
                token="t",
                audio=self.audio[0].endpoint,
                phones=self.phones[0].endpoint,
                faps=self.phones[0].endpoint,
                events=self.phones[0].endpoint,
                facts=SessionFacts(),
            )
            self.commands.send(self.opened, to=self.address)
            self.session: Session = opening.result()

    def close(self) -> None:
        self.client.bus.close()
        self.bus.close()

    def send(self, num_chunks: int) -> None:
        for _ in range(num_chunks):
            assert self.session.send(CHUNK)

    def move(self, next_sequence: int | None) -> None:
        """Move the session to the second recognizer, and wait until the client has been told."""
        moved = SessionMoved(
            session="s",
            epoch=2,
            audio=self.audio[1].endpoint,
            phones=self.phones[1].endpoint,
            faps=self.opened.faps,
            next_sequence=next_sequence,
        )
        self.commands.send(moved, to=self.address)
        while self.session.opened.epoch == 1:
            list(self.session.errors())

    def acknowledge(self, recognizer: int, sequence: int, sender: Peer) -> None:
        """Acknowledge audio, and wait until the client knows."""
        self.audio[recognizer].send(AcknowledgeAudio(session="s", sequence=sequence), to=sender)
        while self.session._acknowledged < sequence:
            list(self.session.errors())

    def take(self, recognizer: int, count: int) -> list[AudioChunk]:
        return [next_of(AudioChunk, self.audio[recognizer])[0] for _ in range(count)]


@pytest.fixture
def stage() -> Iterator[Stage]:
    made = Stage()
    yield made
    made.close()


def test_a_moved_session_sends_again_what_the_new_recognizer_needs(stage: Stage) -> None:
    stage.send(5)
    before = stage.take(0, 5)
    stage.move(next_sequence=3)
    again = stage.take(1, 3)
    assert again == [dataclasses.replace(chunk, epoch=2) for chunk in before[2:]]
    stage.send(1)
    (new,) = stage.take(1, 1)
    assert (new.sequence, new.epoch, new.media_time) == (6, 2, 8000)
    assert not stage.audio[0].wait(0.1)


def test_the_end_is_sent_again_too(stage: Stage) -> None:
    stage.send(1)
    stage.session.finish()
    stage.move(next_sequence=2)
    end, _ = next_of(AudioChunk, stage.audio[1])
    assert (end.sequence, end.epoch) == (2, 2)


def test_audio_goes_on_as_before_when_the_recognizer_is_the_same(stage: Stage) -> None:
    stage.send(2)
    stage.move(next_sequence=None)
    stage.send(1)
    assert [chunk.sequence for chunk in stage.take(0, 3)] == [1, 2, 3]


def test_only_the_newest_audio_is_kept(stage: Stage) -> None:
    stage.send(149)
    stage.take(0, 148)
    stage.acknowledge(0, 149, next_of(AudioChunk, stage.audio[0])[1])
    stage.send(1)
    stage.move(next_sequence=1)
    num_kept = round(RESEND_S / 0.1) + 1
    kept = stage.take(1, num_kept)
    assert [chunk.sequence for chunk in kept] == list(range(151 - num_kept, 151))


def test_what_is_not_acknowledged_is_sent_again(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.send(5)
    stage.take(0, 1)
    _, sender = next_of(AudioChunk, stage.audio[0])
    stage.take(0, 3)
    stage.acknowledge(0, 2, sender)
    monkeypatch.setattr(client_module, "ANSWER_S", (0.0, 0.0))
    stage.session._answer_s = 0.0
    stage.send(1)
    first, other = next_of(AudioChunk, stage.audio[0])
    assert (first.sequence, first.epoch) == (3, 1)
    assert other.address != sender.address, "the old connection may be dead"


def test_the_quickest_answer_tells_how_near_the_recognizer_is(stage: Stage) -> None:
    stage.send(1)
    _, sender = next_of(AudioChunk, stage.audio[0])
    time.sleep(0.14)
    stage.acknowledge(0, 1, sender)
    first_ms = stage.session._near_ms
    assert first_ms >= 280
    end_s = time.monotonic() + 20
    while stage.session._near_ms == first_ms:
        assert time.monotonic() < end_s
        stage.send(2)  # the newest that is acknowledged counts
        stage.take(0, 2)
        stage.acknowledge(0, stage.session._sequence, sender)
    assert NEAREST_MS <= stage.session._near_ms < first_ms


def test_a_recognizer_that_acknowledges_nothing_gets_audio_once(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.session._answer_s = 0.0
    stage.send(3)
    assert [chunk.sequence for chunk in stage.take(0, 3)] == [1, 2, 3]
    stage.send(1)
    assert [chunk.sequence for chunk in stage.take(0, 1)] == [4]


def test_subscriptions_follow(stage: Stage) -> None:
    with ThreadPoolExecutor(1) as pool:
        subscribing = pool.submit(stage.session.subscribe, Phone)
        while not subscribing.done():
            stage.phones[0].wait(0.01)
            list(stage.phones[0].receive())  # confirms
        output = subscribing.result()
    stage.move(next_sequence=1)
    assert stage.phones[1].wait(5.0), "the subscription reaches the new publisher"
    list(stage.phones[1].receive())
    phone = Phone(session="s", index=0, symbol="a", duration=1, confidence=1.0, final=True)
    stage.phones[0].send(phone)
    stage.phones[1].send(dataclasses.replace(phone, epoch=2))
    assert output.wait(5.0)
    epochs = [r.message.epoch for r in output.receive() if isinstance(r.message, Phone)]
    assert epochs == [2]


def flush(stage: Stage) -> None:
    with ThreadPoolExecutor(1) as pool:
        flushing = pool.submit(stage.session.flush)
        request, sender = next_of(FlushSession, stage.commands)
        stage.commands.send(Done(session="s", request=request.request), to=sender)
        flushing.result()


def test_audio_from_before_an_interruption_is_not_sent_again(stage: Stage) -> None:
    stage.send(3)
    flush(stage)
    stage.send(1)
    stage.move(next_sequence=2)
    assert [chunk.sequence for chunk in stage.take(1, 1)] == [4]
    stage.send(1)
    assert [chunk.sequence for chunk in stage.take(1, 1)] == [5]


def test_a_session_that_is_flushed_while_it_moves_has_nothing_to_send(stage: Stage) -> None:
    stage.send(3)
    flush(stage)
    stage.move(next_sequence=2)
    assert not stage.audio[1].wait(0.1)
    assert stage.session.finish()
    assert next_of(AudioChunk, stage.audio[1])[0].sequence == 4


def test_a_session_is_closed_when_its_end_is_acknowledged(stage: Stage) -> None:
    stage.send(1)
    assert stage.session.finish()
    stage.take(0, 1)
    _, sender = next_of(AudioChunk, stage.audio[0])
    with ThreadPoolExecutor(1) as pool:
        closing = pool.submit(stage.session.close)
        assert not stage.commands.wait(0.2)
        stage.audio[0].send(AcknowledgeAudio(session="s", sequence=2), to=sender)
        request, client = next_of(CloseSession, stage.commands)
        stage.commands.send(Done(session="s", request=request.request), to=client)
        closing.result()


def complain(stage: Stage) -> None:
    """Let the first recognizer say that it does not know the session."""
    stage.send(1)
    _, sender = next_of(AudioChunk, stage.audio[0])
    for code in (ErrorCode.UNKNOWN_SESSION, ErrorCode.BAD_AUDIO):
        stage.audio[0].send(Error(session="s", code=code, text=code), to=sender)


def test_an_unknown_session_is_no_error_when_it_moves(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    complain(stage)
    codes: list[str] = []
    while not codes:
        codes += [error.code for error in stage.session.errors()]
    assert codes == ["bad-audio"]
    stage.move(next_sequence=1)
    monkeypatch.setattr(client_module, "MOVE_LIMIT_S", 0.0)
    assert list(stage.session.errors()) == []


def test_an_unknown_session_is_an_error_when_it_does_not_move(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client_module, "MOVE_LIMIT_S", 0.0)
    complain(stage)
    codes: list[str] = []
    while len(codes) < 2:
        codes += [error.code for error in stage.session.errors()]
    assert sorted(codes) == ["bad-audio", "unknown-session"]  # in either order


def test_skipped_audio_advances_media_time(stage: Stage) -> None:
    stage.send(1)
    stage.session.skip(800)
    stage.send(1)
    assert [chunk.media_time for chunk in stage.take(0, 2)] == [0, 2400]


def test_control_is_asked_where_something_else_answered_before() -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    commands = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    with Bus() as bus, Client(commands) as client, ThreadPoolExecutor(1) as pool:
        closing = pool.submit(client.close_session, "s", "t")
        answer_handshake(listener, False, b"\x00\x05hello")
        control = bus.bind_router(commands, "commands")
        message, sender = next_of(CloseSession, control)
        control.send(Done(session="s", request=message.request), to=sender)
        closing.result()
