"""The package ``kouxing-client`` over real sockets: plain and asyncio programs.

The other end is the product's own, so it checks what the package sends.
"""

import asyncio
import socket
import threading
from array import array
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from kouxing_client import (
    AsyncClient,
    AsyncResults,
    Client,
    FapFrame,
    KouxingError,
    Phone,
    Refused,
    Result,
    Shapes,
    aio,
    find_key,
    thread,
)
from kouxing_client import client as blocking
from kouxing_client.base import MAX_UNREAD_RESULTS
from kouxing_client.messages import EndOfFaps

from kouxing.shared.settings.keys import add_key, load_user_key
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.session import CloseSession, Error, OpenSession
from tests.fake_control import FakeControl
from tests.system import LIMIT_S, wait_until

CHUNK = bytes(3200)  # 100 ms


@pytest.fixture
def client(control: FakeControl) -> Iterator[Client]:
    with Client(control.address, insecure=True) as new_client:
        yield new_client


def frame(sequence: int) -> FapFrame:
    return FapFrame(
        session="s",
        epoch=1,
        sequence=sequence,
        media_time=320 * sequence,
        packed_values=np.full(68, sequence, "<f4").tobytes(),
        mask=bytes(9),
        packed_shapes={"vrm": np.array([0.5, *[0] * 11], "<f4").tobytes()},
    )


PHONE = Phone(session="s", epoch=1, index=0, symbol="a", duration=1600, confidence=1.0, final=True)
END = EndOfFaps(session="s", epoch=1, sequence=9)


def test_the_client_finds_the_key_that_commands_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = load_user_key()
    assert find_key() == type(find_key())(key.public, key.secret, key.control)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with pytest.raises(KouxingError, match="kouxing keys add"):
        Client()


def test_a_session_streams_audio_and_receives_results(control: FakeControl, client: Client) -> None:
    with client.open_session("s", sample_rate_hz=48000, num_channels=2) as session:
        results = session.results(FapFrame, Phone, Shapes, shapes="vrm")
        session.push(bytes(1))
        session.push(bytes(4 * 12000 - 1))
        session.finish()
        wait_until(lambda: len(control.audio_messages) == 3)
        control.publish(control.phones, PHONE)
        assert isinstance(results.get(), Phone)
        control.publish(control.faps, frame(1), frame(2), END)
        received = list(results)
        assert results.has_ended
        with pytest.raises(KouxingError, match="complete samples"):
            session.try_push(bytes(6))
    frames = [result for result in received if isinstance(result, FapFrame)]
    shapes = [result for result in received if isinstance(result, Shapes)]
    assert [frame.values for frame in frames] == [array("f", [n] * 68) for n in (1.0, 2.0)]
    assert frames[0].time_s == 0.02
    assert [frame.by_name["aa"] for frame in shapes] == [0.5, 0.5]
    assert [len(chunk.pcm) for chunk in control.audio_messages] == [32000, 16000, 0]
    assert [chunk.media_time for chunk in control.audio_messages] == [0, 2666, 4000]
    assert control.sessions_of(SetFace) == ["s"], "shapes are requested"
    assert control.sessions_of(CloseSession) == ["s"]
    with pytest.raises(KouxingError, match="closed"):
        session.push(CHUNK)


def test_on_result_cannot_call_methods_that_wait(control: FakeControl, client: Client) -> None:
    session = client.open_session("s")
    errors: list[str] = []

    def on_result(_frame: FapFrame) -> None:
        for method in (
            client.close,
            client.status,
            partial(client.open_session, "t"),
            partial(client.follow, "s"),
            partial(session.push, CHUNK),
            session.flush,
            session.set_face,
            session.frames,
            session.close,
        ):
            with pytest.raises(KouxingError) as raised:
                method()
            errors.append(str(raised.value))
        session.try_push(CHUNK)
        session.finish()

    session.results(FapFrame, on_result=on_result)
    control.publish(control.faps, frame(1))
    wait_until(lambda: len(control.audio_messages) == 2)
    assert len(errors) == 9
    assert {error.partition(";")[0] for error in errors} == {
        "on_result cannot call a method that waits for an answer"
    }
    assert not client.is_closed


def test_refusals_of_requests_and_of_audio_are_reported(
    control: FakeControl, client: Client
) -> None:
    session = client.open_session("s")
    session.push(CHUNK)
    wait_until(lambda: control.audio_messages)
    send_audio_error(control)
    wait_until(lambda: session._core.errors)
    with pytest.raises(Refused, match="bad-audio: x"):
        session.push(CHUNK)
    session.push(CHUNK)
    control.refuse = True
    with pytest.raises(Refused, match="no-service: start one") as caught:
        client.open_session()
    assert caught.value.code == "no-service"


def send_audio_error(control: FakeControl) -> None:
    """Let the recognizer report an error about the audio of the session ``s``."""
    error = Error(session="s", code="bad-audio", text="x")
    control.run_job(lambda: control.audio.send(error, to=control.audio_sender))


def test_the_results_report_rejected_audio_that_no_push_has_reported(
    control: FakeControl, client: Client
) -> None:
    session = client.open_session("s")
    frames = session.frames()
    session.push(CHUNK)
    session.finish()
    wait_until(lambda: control.audio_messages and control.audio_messages[-1].last)
    send_audio_error(control)
    wait_until(lambda: session._core.errors)
    control.publish(control.faps, frame(1), END)
    assert frames.get() is not None
    with pytest.raises(Refused, match="bad-audio: x"):
        frames.get()
    assert list(frames) == []


def test_audio_after_its_end_is_rejected(client: Client) -> None:
    session = client.open_session("s")
    session.finish()
    session.finish()
    for push in (session.push, session.try_push):
        with pytest.raises(KouxingError, match=r"finish\(\) has ended .*; open another session"):
            push(CHUNK)


def test_a_key_may_be_a_path(control: FakeControl, tmp_path: Path) -> None:
    add_key("laptop", ["client"], tmp_path / "laptop.key")
    for path in (tmp_path / "laptop.key", str(tmp_path / "laptop.key")):
        with Client(control.address, key=path) as client:
            assert not client.is_closed
    with pytest.raises(KouxingError, match=r"none\.key: No such file"):
        Client(control.address, key=tmp_path / "none.key")


@pytest.mark.parametrize(
    ("address", "insecure", "text"),
    [
        ("127.0.0.1:5550", True, "cannot connect to '127.0.0.1:5550': .*; write tcp://HOST:PORT"),
        ("http://127.0.0.1:8080", True, "cannot connect to 'http://.*; write tcp://HOST:PORT"),
        ("tcp://127.0.0.1", True, "cannot connect to 'tcp://127.0.0.1': .*; write tcp://HOST:PORT"),
        ("tcp://127.0.0.1:1 " + "a" * 40, True, "tcp://127.0.0.1:1 uses encryption, but this"),
    ],
)
def test_refuses_an_address_that_cannot_work(address: str, *, insecure: bool, text: str) -> None:
    with pytest.raises(KouxingError, match=text):
        Client(address, insecure=insecure)


def test_unknown_keywords_and_names_are_rejected(client: Client) -> None:
    options: dict[str, Any] = {"sample_rate": 48000}
    with pytest.raises(TypeError, match="did you mean 'sample_rate_hz'"):
        client.open_session(**options)
    settings: dict[str, Any] = {"lip_mode": "learned"}
    with pytest.raises(TypeError, match="did you mean 'lip_model'"):
        client.set_face("s", **settings)
    with pytest.raises(KouxingError, match="hold_s is how long expressions last"):
        client.set_face("s", hold_s=2)
    no_face: dict[str, Any] = {"face": None}
    assert client.open_session("s", **no_face).name == "s"
    with pytest.raises(KouxingError, match="'a b' is not a valid session name"):
        client.set_face("a b", still=True)


def test_results_may_be_read_in_several_event_loops(control: FakeControl) -> None:
    client = AsyncClient(control.address, insecure=True)

    async def read(frames: AsyncResults[FapFrame]) -> float:
        return (await frames.__anext__()).values[0]

    async def subscribe() -> AsyncResults[FapFrame]:
        return await (await client.open_session("s")).frames()

    frames = asyncio.run(subscribe())
    with ThreadPoolExecutor() as pool:
        readers = [pool.submit(asyncio.run, read(frames)) for _ in range(2)]
        wait_until(lambda: len(frames._signal._tasks) == 2)
        control.publish(control.faps, frame(1), frame(2))
        assert {reader.result() for reader in readers} == {1.0, 2.0}
    asyncio.run(client.close())


class ContendedQueue(deque[FapFrame]):
    """A queue whose first message is taken by another reader."""

    is_contended = True

    def popleft(self) -> FapFrame:
        message = super().popleft()
        if not self.is_contended:
            return message
        self.is_contended = False
        raise IndexError


@pytest.mark.parametrize("is_async", [True, False])
def test_a_reader_waits_again_if_another_one_takes_its_result(
    control: FakeControl, client: Client, is_async: bool
) -> None:
    frames = client.open_session("s").frames()
    frames._inbox.messages = ContendedQueue()
    control.publish(control.faps, frame(1), frame(2))
    if is_async:
        reader: AsyncResults[FapFrame] = AsyncResults(frames._inbox, lambda: None)

        async def read() -> FapFrame:
            return await reader.__anext__()

        assert asyncio.run(read()).sequence == 2
    else:
        assert next(frames).sequence == 2


def test_a_new_subscriber_receives_what_the_publisher_repeats(
    control: FakeControl, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control.faps, "_on_subscribe", lambda _: [frame(1), frame(2)])
    frames = client.open_session("s").frames()
    assert [next(frames).sequence for _ in range(2)] == [1, 2]


def test_a_closed_client_reports_that_it_is_closed(client: Client) -> None:
    session = client.open_session("s")
    client.close()
    assert client.is_closed
    with pytest.raises(KouxingError, match="closed"):
        client.status()
    session.close()  # does not wait for the thread, which has ended
    with pytest.raises(KouxingError, match="closed"):
        session.frames()
    events = session.events()
    with pytest.raises(KouxingError, match="closed"):
        events.get(0.0)
    events.close()


def test_a_request_of_another_thread_fails_while_the_client_ends(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    thread, answers = client._thread, list[Future[Any]]()
    close = thread.core.close

    def close_late(failure: KouxingError) -> None:
        close(failure)
        answer = thread.submit(lambda core: core.request("status-request"), may_wait=False)
        answers.append(answer)

    monkeypatch.setattr(thread.core, "close", close_late)
    client.close()
    (answer,) = answers
    assert answer.done()
    assert "closed" in str(answer.exception())


def test_values_of_numpy_do_not_end_the_client(control: FakeControl, client: Client) -> None:
    session = client.open_session("s")
    with pytest.raises(TypeError, match="numpy"):
        session.set_face(expressiveness=np.float32(1.5))  # type: ignore[arg-type]
    with pytest.raises(KouxingError, match="num_channels=1"):
        session.push(np.zeros((1600, 2), np.int16))
    session.skip(np.int64(1600))  # type: ignore[arg-type]
    session.push(CHUNK)
    assert session.media_time == 1600 + len(CHUNK) // 2
    wait_until(lambda: control.audio_messages)
    assert control.audio_messages[0].media_time == 1600
    assert not client.is_closed


def test_skip_has_the_limits_of_push(client: Client) -> None:
    session = client.open_session("s")
    with pytest.raises(KouxingError, match="num_samples must be at least 0, not -1"):
        session.skip(-1)
    session.finish()
    with pytest.raises(KouxingError, match=r"finish\(\) has ended the audio"):
        session.skip(1600)
    closed = client.open_session("t")
    closed.close()
    with pytest.raises(KouxingError, match="the session is closed"):
        closed.skip(1600)


class Odd(Result, frozen=True, kw_only=True):
    """A message that no service publishes."""

    kind: ClassVar[str] = "odd"
    published_at: ClassVar[str] = "elsewhere"


def test_results_that_the_session_does_not_publish_do_not_end_the_client(client: Client) -> None:
    session = client.open_session("s")
    with pytest.raises(KouxingError, match="session s has no endpoint 'elsewhere'"):
        session.results(Odd)
    assert session.frames()


@pytest.mark.parametrize("is_async", [False, True])
def test_a_failed_subscription_receives_nothing(control: FakeControl, *, is_async: bool) -> None:
    async def subscribe() -> None:
        async with AsyncClient(control.address, insecure=True) as client:
            session = await client.open_session("s")
            control.refuse = True
            with pytest.raises(Refused):
                await session.shapes("vrm")
            await client.status()  # the thread has ended the subscription
            assert not session._core._subscriptions

    if is_async:
        asyncio.run(subscribe())
        return
    with Client(control.address, insecure=True) as client:
        session = client.open_session("s")
        control.refuse = True
        with pytest.raises(Refused):
            session.shapes("vrm")
        client.status()
        assert not session._core._subscriptions


def test_the_asyncio_client_opens_follows_and_closes_a_session(control: FakeControl) -> None:
    published = [frame(number) for number in range(1, 4 * MAX_UNREAD_RESULTS)]

    async def run() -> list[float]:
        async with AsyncClient(control.address, insecure=True) as client:
            assert [state.service for state in (await client.status()).services]
            session = await client.open_session("s")
            newest = await session.frames()
            frames = await session.results(FapFrame, keep_all=True)
            await session.push(CHUNK[:1])
            await session.push(CHUNK[1:])
            await session.set_face(lip_model="learned")
            await session.finish()
            end = EndOfFaps(session="s", epoch=1, sequence=len(published) + 1)
            await asyncio.to_thread(control.publish, control.faps, *published, end)
            assert [result.values[0] async for result in newest][-1] == len(published)
            values = [result.values[0] async for result in frames]
            await session.close()
            return values

    assert asyncio.run(run()) == [float(message.sequence) for message in published]


def test_the_client_reports_why_control_does_not_answer() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        control = f"tcp://127.0.0.1:{other.getsockname()[1]}"
        with (
            Client(control, insecure=True, timeout_s=0.1) as client,
            pytest.raises(KouxingError) as failure,
        ):
            client.status()
    reason = f"control at {control} does not answer: another program answers there"
    assert str(failure.value).startswith(reason)


def test_a_session_disconnects_though_control_does_not_answer(
    control: FakeControl, client: Client
) -> None:
    session = client.open_session("s")
    frames = session.frames()
    control.is_silent = True
    client._thread.core._timeout_s = 0.1
    with pytest.raises(KouxingError, match="does not answer"):
        session.close()
    assert frames.has_ended


@pytest.mark.parametrize("stays_open", [True, False])
def test_a_session_closes_if_its_opening_is_cancelled(
    control: FakeControl, monkeypatch: pytest.MonkeyPatch, stays_open: bool
) -> None:
    monkeypatch.setattr(aio, "LAST_ANSWER_S", LIMIT_S)

    async def run() -> None:
        async with AsyncClient(control.address, insecure=True, timeout_s=LIMIT_S) as client:
            control.is_silent = True
            opening = asyncio.create_task(client.open_session("s"))
            await asyncio.to_thread(wait_until, lambda: control.messages_of(OpenSession))
            opening.cancel()
            with pytest.raises(asyncio.CancelledError):
                await opening
            control.is_silent = False  # it answers the repeated request
            if stays_open:
                await asyncio.to_thread(wait_until, lambda: control.sessions_of(CloseSession))

    asyncio.run(run())
    assert control.sessions_of(CloseSession) == ["s"]


class InterruptedFuture(Future[Any]):
    """A future whose result the user does not wait for."""

    def result(self, timeout: float | None = None) -> Any:
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        return super().result(timeout)


def test_a_session_closes_if_its_opening_is_interrupted(
    control: FakeControl, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blocking, "LAST_ANSWER_S", LIMIT_S)
    with Client(control.address, insecure=True, timeout_s=LIMIT_S) as client:
        control.is_silent = True
        with monkeypatch.context() as interrupted:
            interrupted.setattr(thread, "new_future", InterruptedFuture)
            with pytest.raises(KeyboardInterrupt):
                client.open_session("s")
        control.is_silent = False  # it answers the repeated request
    assert control.sessions_of(CloseSession) == ["s"]
