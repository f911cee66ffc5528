"""A client's core: requests, sessions that move, lost connections; without sockets."""

import gc
import weakref
from collections.abc import Callable
from typing import Any, cast

import pytest
from kouxing_client import SHAPE_NAMES, FapFrame, KouxingError, Phone
from kouxing_client.audio import ANSWER_LIMITS_S
from kouxing_client.connection_check import NO_LISTENER
from kouxing_client.core import MAX_FAILED_OPENINGS, RETRY_S, ClientCore
from kouxing_client.inbox import Inbox
from kouxing_client.messages import EndOfFaps, Joined
from kouxing_client.session_core import (
    LAST_RESULTS_WAIT_S,
    MAX_ERRORS,
    MOVE_TIMEOUT_S,
    RESUBSCRIBE_S,
    SILENT_S,
    SessionCore,
    Subscription,
)

from kouxing.shared.face.shapes import SHAPE_SETS
from tests.fake_sockets import FakeConnection, FakeSockets

START_S = 2.0
ID = "this session"
OPENED = {
    "epoch": 1, "token": "t", "audio": "audio 1", "phones": "phones 1", "faps": "faps 1",
    "events": "events", "session_id": ID,
}  # fmt: skip
MOVED = {"epoch": 2, "audio": "audio 2", "phones": "phones 2", "faps": "faps 1"}
STATE = {"state": "open", "age_s": 1.0, "speaking": False, "workers": {}, "facts": {}}
CONTROL_STATE = {
    "service": "control", "instance": "control", "role": "control", "state": "ready", "age_s": 0.0,
    "clock_offset_ms": 0.0, "endpoints": {"events": "events"}, "metrics": {},
}  # fmt: skip


class CoreHarness:
    """A core with one session."""

    def __init__(self, *, paced: bool = True) -> None:
        self.sockets = FakeSockets()
        self.core = ClientCore(cast(Any, self.sockets), "control", 10.0, START_S)
        opening = self.core.open_session({"sample_rate_hz": 16000, "paced": paced})
        self.answer("session-opened", **OPENED)
        self.session: SessionCore = opening.result()

    @property
    def commands(self) -> FakeConnection:
        (connection,) = self.sockets.at("control")
        return connection

    def answer(self, kind: str, **fields: object) -> None:
        """Answer the newest request."""
        _, request = self.commands.sent[-1]
        self.commands.answer(kind, request=request["request"], **fields)

    def audio(self, number: int = 1) -> FakeConnection:
        (connection,) = self.sockets.at(f"audio {number}")
        return connection

    def push(self, count: int) -> None:
        for _ in range(count):
            self.session.add_audio(1600, {"pcm": b""})

    def pass_time(self, seconds: float) -> None:
        self.sockets.now_s += seconds
        self.core.tick()

    def subscribe(self) -> Inbox:
        """Subscribe to frames."""
        inbox = Inbox(None)
        self.session.subscribe(Subscription(self.session, (FapFrame,), "", inbox))
        return inbox

    def confirm(self) -> None:
        """Confirm the newest subscription from both publishers."""
        for name in ("a", "b"):
            self.sockets.connections[-1].on_message(Joined(publisher=name))


def sequences(connection: FakeConnection) -> list[int]:
    return [fields["sequence"] for _, fields in connection.sent]


def test_client_and_product_have_the_same_shape_names() -> None:
    assert {name: shapes.names for name, shapes in SHAPE_SETS.items()} == SHAPE_NAMES


def test_repeats_a_request_until_the_time_limit() -> None:
    harness = CoreHarness()
    answer = harness.core.request("flush-session", "s")
    for _ in range(3):
        harness.pass_time(RETRY_S)
    requests = [
        fields["request"] for kind, fields in harness.commands.sent if kind.startswith("flu")
    ]
    assert len(requests) == 4
    assert len(set(requests)) == 1
    harness.pass_time(10.0)
    assert "Start it with 'kouxing run'" in str(answer.exception(0))
    harness.commands.on_refused(True)
    answer = harness.core.request("flush-session", "s")
    harness.pass_time(10.1)
    assert "rejects this client" in str(answer.exception(0))
    harness.sockets.unreachable_reason = "another program answers there"
    answer = harness.core.request("flush-session", "s")
    harness.pass_time(10.1)
    assert "control does not answer: another program" in str(answer.exception(0))
    harness.pass_time(10.0)
    assert harness.sockets.num_explained == 3  # an idle client does not connect again and again


@pytest.mark.parametrize("unnamed", [{}, {"request": ""}])  # control of version 3, of version 2
def test_a_bad_request_does_not_affect_other_requests(unnamed: dict[str, str]) -> None:
    harness = CoreHarness()
    first, bad, last = (harness.core.request("flush-session", "s") for _ in range(3))
    _, fields = harness.commands.sent[-2]
    harness.commands.answer("error", code="bad-message", text="x", request=fields["request"])
    assert "x" in str(bad.exception(0))
    assert not first.done()
    harness.answer("done")
    assert last.done()
    harness.commands.answer("error", code="bad-message", text="upgrade", **unnamed)
    assert "upgrade" in str(first.exception(0))


@pytest.mark.parametrize("reason", [NO_LISTENER, "the connection times out"])
def test_reports_early_that_nothing_listens_at_an_address(reason: str) -> None:
    sockets = FakeSockets()
    core = ClientCore(cast(Any, sockets), "control", 10.0, START_S)
    sockets.unreachable_reason = reason
    answer = core.request("flush-session", "s")
    for _ in range(2):
        assert not answer.done()
        sockets.now_s += 0.6 * START_S
        core.tick()
    assert answer.done() == (reason == NO_LISTENER)
    core.tick()
    assert sockets.num_explained == 1
    sockets.now_s += 10.0
    core.tick()
    assert reason in str(answer.exception(0))


def test_a_restarting_control_has_the_whole_time_limit() -> None:
    harness = CoreHarness()
    harness.sockets.unreachable_reason = NO_LISTENER
    answer = harness.core.request("flush-session", "s")
    harness.pass_time(9.9)
    assert not answer.done()
    harness.answer("done")
    assert answer.done()


def test_status_collects_all_pages() -> None:
    harness = CoreHarness()
    status = harness.core.status("")
    harness.answer("status-report", services=[CONTROL_STATE], sessions=[], next=7)
    assert harness.commands.sent[-1][1]["after"] == 7
    state = {**STATE, "session": "s", "endpoints": {}}
    harness.answer("status-report", services=[], sessions=[state], next=None)
    assert [service.service for service in status.result().services] == ["control"]
    assert [session.session for session in status.result().sessions] == ["s"]


def test_a_moved_session_sends_the_new_recognizer_what_it_needs() -> None:
    harness = CoreHarness()
    harness.push(5)
    old = harness.audio()
    harness.commands.answer("session-moved", **MOVED, next_sequence=3)
    harness.core.tick()
    assert not old.is_open
    assert sequences(harness.audio(2)) == [3, 4, 5]
    assert {fields["epoch"] for _, fields in harness.audio(2).sent} == {2}
    harness.commands.answer("session-moved", **MOVED, next_sequence=3)  # control may repeat it
    harness.push(1)
    assert sequences(harness.audio(2)) == [3, 4, 5, 6]
    moved = {**MOVED, "epoch": 3, "phones": "phones 3"}  # the recognizer stays
    harness.commands.answer("session-moved", **moved)
    harness.push(1)
    assert sequences(harness.audio(2)) == [3, 4, 5, 6, 7]


def test_reconnects_and_resends_if_acknowledgements_stop() -> None:
    harness = CoreHarness()
    harness.push(3)
    dead = harness.audio()
    dead.answer("acknowledge", sequence=1)
    harness.pass_time(ANSWER_LIMITS_S[0] + 0.1)
    assert not dead.is_open
    assert sequences(harness.audio()) == [2, 3]
    assert harness.audio().connect_ms < 300, "the round trip was shorter"


def test_audio_waits_for_subscriptions_so_that_no_frame_is_missed() -> None:
    harness = CoreHarness()
    harness.subscribe()
    harness.confirm()
    harness.push(2)
    harness.audio().answer("acknowledge", sequence=1)
    harness.pass_time(ANSWER_LIMITS_S[0] + 0.1)
    assert sequences(harness.audio()) == []
    harness.pass_time(RESUBSCRIBE_S)
    assert sequences(harness.audio()) == [2]


def test_ends_after_the_last_phones_though_a_publisher_confirms_late() -> None:
    harness, inbox = CoreHarness(), Inbox(None)
    harness.session.subscribe(Subscription(harness.session, (Phone,), "", inbox))
    harness.sockets.connections[-1].on_message(EndOfFaps(session="s", epoch=1, sequence=1))
    harness.confirm()  # the first subscription; phones may follow
    assert not inbox.has_ended
    harness.confirm()
    assert inbox.has_ended


def test_an_unknown_session_ends_unless_it_moves() -> None:
    harness = CoreHarness()
    harness.push(1)
    harness.audio().answer("error", code="unknown-session", text="x")
    harness.audio().answer("error", code="bad-audio", text="y")
    assert [error.code for error in harness.session.errors] == ["bad-audio"]
    harness.commands.answer("session-moved", **MOVED, next_sequence=1)
    harness.pass_time(MOVE_TIMEOUT_S + 0.1)
    assert not harness.session.has_ended
    harness.audio(2).answer("error", code="unknown-session", text="x")
    harness.pass_time(MOVE_TIMEOUT_S + 0.1)
    assert harness.session.has_ended
    assert "unknown-session" in str(harness.session.failure)


def test_keeps_only_the_newest_errors_that_a_program_does_not_take() -> None:
    harness = CoreHarness()
    for number in range(MAX_ERRORS + 1):
        harness.audio().answer("error", code="bad-audio", text=str(number))
    texts = [error.text for error in harness.session.errors]
    assert texts == [str(number) for number in range(1, MAX_ERRORS + 1)]


def test_a_message_that_the_recognizer_cannot_read_ends_the_session() -> None:
    harness = CoreHarness()
    inbox = harness.subscribe()
    harness.push(1)
    harness.audio().answer("error", code="bad-message", text="media_time must be ...")
    assert harness.session.has_ended
    assert "bad-message" in str(inbox.failure)
    harness.pass_time(ANSWER_LIMITS_S[1])
    assert sequences(harness.audio()) == [1]
    assert harness.commands.sent[-1][0] == "close-session"


@pytest.mark.parametrize("cause", ["moved", "replaced", "ended"])
def test_asks_where_a_silent_session_of_another_program_is(cause: str) -> None:
    harness = CoreHarness()
    following = harness.core.follow("other", is_paced=True)
    endpoints = {"audio": "a", "phones": "phones 1", "faps": "faps 1"}
    state = {**STATE, "session": "other", "session_id": ID, "endpoints": endpoints}
    harness.answer("status-report", services=[CONTROL_STATE], sessions=[state])
    harness.session = following.result()
    inbox = harness.subscribe()
    harness.confirm()
    harness.pass_time(SILENT_S + 0.1)
    assert harness.commands.sent[-1][0] == "status-request"
    if cause == "moved":
        state["endpoints"] = {**endpoints, "faps": "faps 2"}
        harness.answer("status-report", services=[], sessions=[state])
        assert harness.sockets.at("faps 2")
        assert not inbox.has_ended
    else:
        if cause == "replaced":
            state["session_id"] = "another session with its name"
            harness.answer("status-report", services=[], sessions=[state])
        else:
            harness.answer("error", code="unknown-session", text="x")
        assert inbox.has_ended
        assert inbox.failure is None


def test_a_session_ends_when_control_rejects_its_key_for_long() -> None:
    harness = CoreHarness()
    inbox = harness.subscribe()
    for is_refused in (True, False, True, True):  # the first refusal is short
        harness.commands.on_refused(is_refused)
        assert not inbox.has_ended
        harness.pass_time(6.0)
    assert inbox.has_ended
    assert "rejects this client" in str(inbox.failure)


@pytest.mark.parametrize("reason", ["closed by control", "closed by the program", "last frame"])
def test_failing_on_result_does_not_keep_other_sessions_open(reason: str) -> None:
    harness = CoreHarness()

    def fail(_result: object) -> None:
        raise ValueError("a bug")

    inbox = Inbox(None)
    failing = Subscription(harness.session, (FapFrame, Phone), "", inbox, fail)
    harness.session.subscribe(failing)
    other = harness.subscribe()
    if reason == "last frame":
        harness.sockets.publish("faps 1", EndOfFaps(session="s", epoch=1, sequence=1))
    stamp: dict[str, Any] = {"session": "s", "epoch": 1, "sequence": 1}
    phone = Phone(**stamp, index=0, symbol="a", duration=1600, confidence=1.0, final=True)
    harness.sockets.at("phones 1")[0].unread.append(phone)
    harness.session.end(None if reason == "closed by the program" else KouxingError(reason))
    assert inbox.has_ended
    assert "on_result failed: ValueError('a bug')" in str(inbox.failure)
    assert other.has_ended
    assert harness.session.has_ended


def test_closes_a_session_that_opens_after_its_request_has_failed() -> None:
    harness = CoreHarness()
    opening = harness.core.open_session({"sample_rate_hz": 16000, "session": "late"})
    harness.pass_time(10.1)
    assert opening.exception(0) is not None
    _, request = harness.commands.sent[-1]
    for _ in range(2):  # control repeats the answer
        harness.commands.answer("session-opened", request=request["request"], **OPENED)
    assert [kind for kind, _ in harness.commands.sent].count("close-session") == 1
    kind, closing = harness.commands.sent[-1]
    assert (kind, closing["session"], closing["token"]) == ("close-session", "s", "t")
    assert len(harness.core.sessions) == 1


def test_remembers_a_limited_number_of_failed_openings() -> None:
    harness = CoreHarness()
    for number in range(MAX_FAILED_OPENINGS + 1):
        harness.core.open_session({"sample_rate_hz": 16000, "session": f"late-{number}"})
    requests = [fields["request"] for _, fields in harness.commands.sent[1:]]
    harness.pass_time(10.1)
    for request in requests[:2]:  # only the oldest one is forgotten
        harness.commands.answer("session-opened", request=request, **OPENED)
    assert [kind for kind, _ in harness.commands.sent].count("close-session") == 1


def test_events_can_be_closed_twice() -> None:
    harness, first, second = CoreHarness(), Inbox(None), Inbox(None)
    for inbox in (first, second):
        harness.core.add_inbox(harness.session, inbox)
    for _ in range(2):
        harness.core.remove_inbox(harness.session, first)
    assert first.has_ended
    assert not second.has_ended


def test_a_session_without_inboxes_is_freed_when_it_is_over() -> None:
    harness, inbox = CoreHarness(), Inbox(None)
    harness.core.add_inbox(harness.session, inbox)
    harness.core.remove_inbox(harness.session, inbox)
    harness.session.end(None)
    harness.core.tick()
    session = weakref.ref(harness.session)
    del harness.session
    harness.sockets.connections.clear()
    gc.collect()
    assert session() is None


@pytest.mark.parametrize(
    ("session_id", "is_same"), [(ID, True), ("an earlier session", False), (None, True)]
)
def test_late_event_of_an_ended_session_does_not_affect_its_successor(
    session_id: str | None, is_same: bool
) -> None:
    harness, inbox = CoreHarness(), Inbox(None)
    harness.core.add_inbox(harness.session, inbox)
    (events,) = harness.sockets.at("events")
    events.answer("session-moved", **MOVED, session_id=session_id)
    assert harness.session.epoch == (2 if is_same else 1)
    events.answer("event", name="session-closed", session_id=session_id)
    assert len(inbox.messages) == is_same
    harness.pass_time(2 * LAST_RESULTS_WAIT_S)
    assert harness.session.has_ended == is_same


def test_a_diagnosis_may_arrive_after_the_client_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    harness, reasons = CoreHarness(), list[Callable[[str], None]]()
    monkeypatch.setattr(harness.sockets, "explain", lambda _, on_reason: reasons.append(on_reason))
    answer = harness.core.request("flush-session", "s")
    harness.pass_time(10.1)
    harness.core.close(KouxingError("the client is closed"))
    (on_reason,) = reasons
    on_reason("")
    assert "closed" in str(answer.exception(0))
