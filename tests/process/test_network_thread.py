"""The thread of the block network: when it starts, and what it reports."""

from collections.abc import Sequence
from typing import Any, cast

import pytest

from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.sessions.network_thread import (
    MAX_SESSIONS,
    MAX_WAIT_S,
    NetworkThread,
)
from kouxing.services.recognizer.sessions.session import RecognizerSession


class FakeSession:
    """A session whose stream is itself."""

    def __init__(self) -> None:
        self.waits_for_network = self.is_scoring = False
        self.stream = self
        self.num_scored = 0

    def begin_background_scoring(self) -> None:
        assert self.is_scoring

    def end_background_scoring(self) -> None:
        self.num_scored += 1


class FakeRecognizer:
    """Records the streams that it decodes, and then raises an error, if any."""

    def __init__(self) -> None:
        self.batches: list[Sequence[Any]] = []
        self.error: Exception | None = None

    def decode_speech(self, streams: Sequence[Any]) -> None:
        self.batches.append(streams)
        if self.error is not None:
            raise self.error


@pytest.fixture
def recognizer() -> FakeRecognizer:
    return FakeRecognizer()


@pytest.fixture
def thread(recognizer: FakeRecognizer) -> NetworkThread:
    return NetworkThread(cast(Recognizer, recognizer), lambda: None)


def make_sessions(num: int) -> list[RecognizerSession]:
    return [cast(RecognizerSession, FakeSession()) for _ in range(num)]


def decoded(thread: NetworkThread) -> list[RecognizerSession]:
    """Return the next sessions that the thread has decoded."""
    thread.wait()
    return thread.take_decoded()


def test_the_thread_decodes_waiting_sessions_once_and_in_order(
    thread: NetworkThread, recognizer: FakeRecognizer
) -> None:
    sessions = make_sessions(MAX_SESSIONS + 1)
    for session in [*sessions, *sessions]:
        thread.add(session, 0.0)
    assert all(session.waits_for_network for session in sessions)
    thread.start(0.0)
    assert [session.is_scoring for session in sessions] == [True] * MAX_SESSIONS + [False]
    assert decoded(thread) == sessions[:MAX_SESSIONS]
    thread.start(0.0)
    assert decoded(thread) == sessions[MAX_SESSIONS:]
    assert not any(session.waits_for_network or session.is_scoring for session in sessions)
    assert [cast(FakeSession, session).num_scored for session in sessions] == [1] * len(sessions)
    assert [len(batch) for batch in recognizer.batches] == [MAX_SESSIONS, 1]


def test_under_load_sessions_wait_for_others_for_a_limited_time(thread: NetworkThread) -> None:
    first, *others = make_sessions(MAX_SESSIONS)
    thread.add(first, 0.0)
    thread.start(0.5 * MAX_WAIT_S, may_wait=True)
    assert first.waits_for_network
    thread.start(MAX_WAIT_S, may_wait=True)
    assert decoded(thread) == [first]
    for session in [first, *others]:
        thread.add(session, 1.0)
    thread.start(1.0, may_wait=True)
    assert decoded(thread) == [first, *others]


def test_an_error_of_the_decoding_is_raised(
    thread: NetworkThread, recognizer: FakeRecognizer
) -> None:
    recognizer.error = ValueError("broken")
    (session,) = make_sessions(1)
    thread.add(session, 0.0)
    thread.start(0.0)
    thread.wait()
    with pytest.raises(ValueError, match="broken"):
        thread.take_decoded()
