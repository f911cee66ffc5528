"""The package ``kouxing-client`` over real sockets, with the services played by the test.

The services' side is the product's own, so that what the package sends is checked by it.
"""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import time
from array import array
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from kouxing_client import (
    SHAPE_NAMES,
    AsyncClient,
    Client,
    FapFrame,
    KouxingError,
    Phone,
    Refused,
    Session,
    audio_stream,
    core,
    find_key,
    follower,
    session_core,
)
from kouxing_client.audio import to_pcm

from kouxing.shared.bus import Bus, Socket
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.keys import Peer, user_key
from kouxing.shared.wire import face, speech
from kouxing.shared.wire.audio import AcknowledgeAudio, AudioChunk
from kouxing.shared.wire.control import Event
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    FlushSession,
    OpenSession,
    SessionFacts,
    SessionMoved,
    SessionOpened,
)

pytestmark = pytest.mark.unit
LOCAL = "tcp://127.0.0.1:*"
CHUNK = bytes(3200)  # 100 ms
TOKEN = "t"  # noqa: S105 - not a secret, but what the protocol calls so
M = TypeVar("M", bound=Message)
T = TypeVar("T")


def next_of(kind: type[M], socket: Socket) -> tuple[M, Peer]:
    """Return the next message, which must be of a kind, and its sender."""
    assert socket.wait(10.0)
    received = next(socket.receive())
    assert isinstance(received.message, kind), received.message
    return received.message, received.sender


class Stage:
    """Control, and two workers of each kind."""

    def __init__(self) -> None:
        self.bus = Bus()
        self.commands = self.bus.bind_router(LOCAL, "commands")
        self.events = self.bus.bind_publisher(LOCAL, "events")
        self.audio = [self.bus.bind_router(LOCAL, "audio") for _ in range(2)]
        self.phones = [self.bus.bind_publisher(LOCAL, "phones") for _ in range(2)]
        self.faps = self.bus.bind_publisher(LOCAL, "faps")
        self.client = Client(self.commands.endpoint, insecure=True)
        self.peer = Peer()
        self.pool = ThreadPoolExecutor(1)
        self.paced = True

    def close(self) -> None:
        self.client.close()
        self.pool.shutdown()
        self.bus.close()

    def open(self, **options: Any) -> Session:
        opening = self.pool.submit(self.client.open_session, **options)
        self.answer_open()
        return opening.result()

    def answer_open(self) -> None:
        request, self.peer = next_of(OpenSession, self.commands)
        opened = SessionOpened(
            session="s",
            epoch=1,
            request=request.request,
            token=TOKEN,
            audio=self.audio[0].endpoint,
            phones=self.phones[0].endpoint,
            faps=self.faps.endpoint,
            events=self.events.endpoint,
            facts=SessionFacts(),
        )
        self.commands.send(opened, to=self.peer)

    def confirm_until(self, future: Future[T]) -> T:
        """Let the publishers confirm subscriptions until a call is over."""
        while not future.done():
            for publisher in (*self.phones, self.faps, self.events):
                publisher.wait(0.002)
                list(publisher.receive())
        return future.result()

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        return self.confirm_until(self.pool.submit(function, *arguments))

    def move(self, next_sequence: int) -> None:
        """Move the session to the second recognizer; the synthesizer stays."""
        moved = SessionMoved(
            session="s",
            epoch=2,
            audio=self.audio[1].endpoint,
            phones=self.phones[1].endpoint,
            faps=self.faps.endpoint,
            next_sequence=next_sequence,
        )
        self.commands.send(moved, to=self.peer)

    def take(self, recognizer: int, count: int) -> list[AudioChunk]:
        return [next_of(AudioChunk, self.audio[recognizer])[0] for _ in range(count)]


@pytest.fixture
def stage() -> Iterator[Stage]:
    made = Stage()
    yield made
    made.close()


def frame(sequence: int, epoch: int = 1) -> face.FapFrame:
    return face.FapFrame(
        session="s",
        epoch=epoch,
        sequence=sequence,
        media_time=320 * sequence,
        values=np.full(68, sequence, "<f4").tobytes(),
        mask=bytes(9),
    )


def phone(sequence: int, epoch: int = 1) -> speech.Phone:
    return speech.Phone(
        session="s",
        epoch=epoch,
        sequence=sequence,
        media_time=0,
        index=sequence,
        symbol="a",
        duration=1600,
        confidence=1.0,
        final=True,
    )


def push_on(session: Session) -> None:
    """Push until the session knows of an error."""
    while True:
        session.push(CHUNK[:2])


FLOATS = [0.0, 0.5, -1.0, 2.0]
AS_INTEGERS = array("h", [0, 16384, -32767, 32767])


@pytest.mark.parametrize(
    "audio",
    [
        AS_INTEGERS.tobytes(),
        AS_INTEGERS,
        FLOATS,
        array("f", FLOATS),
        np.array(FLOATS),
        np.array(FLOATS, np.float32).reshape(2, 2),
        np.array(AS_INTEGERS, np.int16)[::1],
    ],
    ids=lambda audio: type(audio).__name__,
)
def test_audio_may_be_bytes_or_numbers(audio: object) -> None:
    assert to_pcm(audio, "s16le") == AS_INTEGERS.tobytes()


def test_floats_stay_floats_where_these_are_sent() -> None:
    assert to_pcm(FLOATS, "f32le") == array("f", FLOATS).tobytes()
    scaled = array("f", to_pcm(AS_INTEGERS, "f32le"))
    assert scaled == pytest.approx([0.0, 0.5, -1.0, 1.0], abs=1e-4)


def test_the_key_is_the_one_that_commands_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = user_key()
    assert vars(find_key()) == {
        "public": own.public,
        "secret": own.secret,
        "control": own.control,
    }
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with pytest.raises(KouxingError, match="kouxing keys add"):
        Client()
    (tmp_path / "kouxing").mkdir()
    (tmp_path / "kouxing" / "client.key").write_text('{"public": "short"}')
    with pytest.raises(KouxingError, match="is not a key file"):
        Client()


def test_large_audio_goes_in_several_messages_with_their_times(stage: Stage) -> None:
    session = stage.open(sample_rate_hz=48000, num_channels=2)
    session.push(bytes(4 * 12000))
    session.finish()
    audio = stage.take(0, 3)
    assert [len(chunk.pcm) for chunk in audio] == [32000, 16000, 0]
    assert [chunk.last for chunk in audio] == [False, False, True]
    assert [chunk.media_time for chunk in audio] == [0, 2666, 4000]
    assert [chunk.sequence for chunk in audio] == [1, 2, 3]
    assert {(chunk.token, chunk.epoch, chunk.acknowledge) for chunk in audio} == {(TOKEN, 1, True)}
    with pytest.raises(KouxingError, match="whole samples"):
        session.push(bytes(6))


def test_a_moved_session_sends_again_what_the_new_recognizer_needs(stage: Stage) -> None:
    session = stage.open()
    for _ in range(5):
        session.push(CHUNK)
    before = stage.take(0, 5)
    stage.move(next_sequence=3)
    again = stage.take(1, 3)
    assert [chunk.sequence for chunk in again] == [3, 4, 5]
    assert [chunk.media_time for chunk in again] == [chunk.media_time for chunk in before[2:]]
    assert {chunk.epoch for chunk in again} == {2}
    session.push(CHUNK)
    assert stage.take(1, 1)[0].sequence == 6


def test_what_is_not_acknowledged_is_sent_again_over_a_new_connection(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audio_stream, "ANSWER_S", (0.1, 10.0))
    session = stage.open()
    for _ in range(3):
        session.push(CHUNK)
    _, sender = next_of(AudioChunk, stage.audio[0])
    stage.take(0, 2)
    stage.audio[0].send(AcknowledgeAudio(session="s", sequence=1), to=sender)
    again, other = next_of(AudioChunk, stage.audio[0])
    assert again.sequence == 2
    assert other.address != sender.address


def test_a_sender_waits_for_a_recognizer_that_is_slower(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kouxing_client.base.MAX_UNACKNOWLEDGED", 4)
    session = stage.open(paced=False)
    pushing = stage.pool.submit(session.push, bytes(32000 * 5))
    _, sender = next_of(AudioChunk, stage.audio[0])
    stage.take(0, 3)
    assert not stage.audio[0].wait(0.05)
    assert not pushing.done()
    stage.audio[0].send(AcknowledgeAudio(session="s", sequence=1), to=sender)
    assert stage.take(0, 1)[0].sequence == 5
    pushing.result()


def test_results_come_once_and_follow_a_move(stage: Stage) -> None:
    session = stage.open()
    results = stage.call(session.results, FapFrame, Phone)
    stage.faps.send(frame(1))
    stage.phones[0].send(phone(1))
    first = {type(found): found for found in itertools.islice(results, 2)}
    assert set(first) == {FapFrame, Phone}
    assert list(first[FapFrame].values) == [1.0] * 68
    assert first[FapFrame].time_s == 0.02
    stage.move(next_sequence=0)
    while not stage.phones[1].wait(0.01):  # the subscriptions reach the new publisher
        list(stage.faps.receive())
    list(stage.phones[1].receive())
    stage.phones[1].send(phone(1, epoch=2))
    while (found := results.get()) and not isinstance(found, Phone):
        pass
    assert found is not None
    assert found.epoch == 2
    stage.phones[0].send(phone(2))  # of the lost one: void
    for each in (frame(1, epoch=2), frame(2, epoch=2)):  # the first was shown
        stage.faps.send(each)
    stage.faps.send(face.EndOfFaps(session="s", epoch=2, sequence=3))
    assert [(type(each), each.sequence) for each in results] == [(FapFrame, 2)]


def test_what_waited_while_the_process_was_stopped_is_left_but_for_the_newest(
    stage: Stage,
) -> None:
    session = stage.open()
    results = stage.call(session.frames)
    sockets = stage.client._thread._sockets
    sockets.resumed_at_s = time.monotonic() + 1.0  # as if it were stopped until then
    for number in range(1, 31):
        stage.faps.send(frame(number))
    assert results.get(1.5) is None
    stage.faps.send(frame(31))
    numbers = [results.get(10.0).sequence for _ in range(follower.MAX_OLD + 1)]  # type: ignore[union-attr]
    assert numbers == list(range(31 - follower.MAX_OLD, 32))


def test_shapes_have_the_names_of_the_protocol() -> None:
    assert {name: shapes.names for name, shapes in SHAPE_SETS.items()} == SHAPE_NAMES


def test_shapes_are_asked_for_unless_they_come_already(stage: Stage) -> None:
    session = stage.open(shapes=["vrm"])
    weights = np.array([0.5, *[0] * 11], "<f4").tobytes()
    shapes = dataclasses.replace(frame(1), shapes={"vrm": weights})
    end = face.EndOfFaps(session="s", epoch=1, sequence=2)
    vrm = stage.call(session.shapes, "vrm")
    asking = stage.pool.submit(session.shapes, "arkit")
    while not stage.commands.wait(0.005):
        list(stage.faps.receive())
    request, peer = next_of(face.SetFace, stage.commands)
    assert (request.session, request.face.shapes) == ("s", ["arkit"])
    assert request.request is not None
    stage.commands.send(Done(session="s", request=request.request), to=peer)
    arkit = asking.result()
    stage.faps.send(shapes)
    stage.faps.send(end)
    assert [each.by_name["aa"] for each in vrm] == [0.5]
    assert list(arkit) == []


def test_control_refuses(stage: Stage) -> None:
    opening = stage.pool.submit(stage.client.open_session)
    request, peer = next_of(OpenSession, stage.commands)
    refusal = Error(code="busy", text="full", request=request.request, retry_after_s=2.0)
    stage.commands.send(refusal, to=peer)
    with pytest.raises(Refused, match="busy: full") as caught:
        opening.result()
    assert (caught.value.code, caught.value.retry_after_s) == ("busy", 2.0)


def test_an_error_is_raised_where_audio_waits_for_room(stage: Stage) -> None:
    session = stage.open()
    session.push(CHUNK)
    _, sender = next_of(AudioChunk, stage.audio[0])
    pushing = stage.pool.submit(push_on, session)
    while session._has_room():
        time.sleep(0.01)
    stage.audio[0].send(Error(session="s", code="bad-mouth-profile", text="x"), to=sender)
    with pytest.raises(Refused, match="bad-mouth-profile"):
        pushing.result(20)


def test_errors_of_audio_are_raised_once_and_an_unknown_session_ends(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = stage.open()
    session.push(CHUNK)
    _, sender = next_of(AudioChunk, stage.audio[0])
    stage.audio[0].send(Error(session="s", code="bad-mouth-profile", text="x"), to=sender)
    with pytest.raises(Refused, match="bad-mouth-profile"):
        push_on(session)
    taken = AcknowledgeAudio(session="s", sequence=session._num_added)
    stage.audio[0].send(taken, to=sender)  # there may be no room else
    session.push(CHUNK)
    monkeypatch.setattr(session_core, "MOVE_LIMIT_S", 0.0)
    stage.audio[0].send(Error(session="s", code="unknown-session", text="x"), to=sender)
    with pytest.raises(Refused, match="unknown-session"):
        push_on(session)


def test_a_session_that_control_closes_ends(stage: Stage) -> None:
    session = stage.open()
    frames = stage.call(session.frames)
    reading = stage.pool.submit(list, frames)
    while not reading.done():
        list(stage.events.receive())  # a subscription
        stage.events.send(Event(session="s", name="session-closed", detail="idle"))
        stage.events.wait(0.01)
    with pytest.raises(KouxingError, match="control has closed the session: idle"):
        reading.result()


def test_an_interruption_sends_nothing_of_before_again(stage: Stage) -> None:
    session = stage.open()
    session.push(CHUNK)
    stage.take(0, 1)
    flushing = stage.pool.submit(session.flush)
    request, sender = next_of(FlushSession, stage.commands)
    assert request.token == TOKEN
    stage.commands.send(Done(session="s", request=request.request), to=sender)
    flushing.result()
    stage.move(next_sequence=1)
    session.push(CHUNK)
    assert stage.take(1, 1)[0].sequence == 2


def test_closing_waits_until_the_end_has_arrived(stage: Stage) -> None:
    session = stage.open()
    session.finish()
    _, sender = next_of(AudioChunk, stage.audio[0])
    closing = stage.pool.submit(session.close)
    assert not stage.commands.wait(0.05)
    stage.audio[0].send(AcknowledgeAudio(session="s", sequence=1), to=sender)
    request, sender = next_of(CloseSession, stage.commands)
    stage.commands.send(Done(session="s", request=request.request), to=sender)
    closing.result()
    with pytest.raises(KouxingError, match="closed"):
        session.push(CHUNK)


def test_asyncio_does_the_same(stage: Stage) -> None:
    async def run() -> list[float]:
        async with AsyncClient(stage.commands.endpoint, insecure=True) as client:
            session = await client.open_session()
            frames = await session.frames()
            await session.push(CHUNK)
            taken = [found.values[0] async for found in frames]
            with pytest.raises(KouxingError, match="whole samples"):
                await session.push(b"\0")
            return taken

    running = stage.pool.submit(asyncio.run, run())
    stage.answer_open()
    while not stage.audio[0].wait(0.005):
        for publisher in (stage.phones[0], stage.faps):
            list(publisher.receive())
    for sequence in (1, 2):
        stage.faps.send(frame(sequence))
    stage.faps.send(face.EndOfFaps(session="s", epoch=1, sequence=3))
    assert running.result() == [1.0, 2.0]


def test_requests_are_answered_at_once_while_audio_streams(stage: Stage) -> None:
    """Requests and audio use one thread, so that neither takes the other's messages."""
    num_flushes = 20

    async def run() -> list[float]:
        async with AsyncClient(stage.commands.endpoint, insecure=True) as client:
            session = await client.open_session()
            times_s: list[float] = []

            async def stream() -> None:
                while len(times_s) < num_flushes:
                    session.try_push(CHUNK)
                    session.take_errors()
                    await asyncio.sleep(0.0005)

            streaming = asyncio.create_task(stream())
            for _ in range(num_flushes):
                begin_s = time.monotonic()
                await session.flush()
                times_s.append(time.monotonic() - begin_s)
            await streaming
            return times_s

    running = stage.pool.submit(asyncio.run, run())
    stage.answer_open()
    while not running.done():
        if stage.commands.wait(0.002):
            request, peer = next_of(FlushSession, stage.commands)
            stage.commands.send(Done(session="s", request=request.request), to=peer)
    assert max(running.result()) < core.RETRY_S, "no answer was lost"
