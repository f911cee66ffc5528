"""Control's rules, without sockets."""

from __future__ import annotations

import dataclasses

import pytest

from services.control.sessions import Refusal, Registry
from shared.messages import Heartbeat, OpenSession

pytestmark = pytest.mark.unit


def heartbeat(service: str, instance: str, state: str = "ready") -> Heartbeat:
    return Heartbeat(
        service=service,
        instance=instance,
        state=state,
        sent_ns=0,
        endpoints={
            "audio": f"tcp://{instance}:5560",
            "phones": f"tcp://{instance}:5561",
        },
    )


def registry(max_sessions: int = 8) -> Registry:
    made = Registry(max_sessions, lost_after_s=3.0)
    for service in ("recognizer", "synthesizer"):
        made.beat(heartbeat(service, f"{service}-1"), service.encode(), 0.0)
    return made


def opening(session: str = "") -> OpenSession:
    return OpenSession(session=session, request="r")


def test_a_session_gets_a_name_a_token_and_its_services() -> None:
    record = registry().open(opening(), b"client", 0.0)
    assert record.name
    assert len(record.token) >= 32
    assert record.waiting_for == {"recognizer-1", "synthesizer-1"}


def test_names_and_tokens_differ() -> None:
    made = registry()
    records = [made.open(opening(), b"client", 0.0) for _ in range(5)]
    assert len({record.name for record in records} | {record.token for record in records}) == 10


@pytest.mark.parametrize("service", ["recognizer", "synthesizer"])
def test_a_missing_service_is_named(service: str) -> None:
    made = registry()
    del made.services[f"{service}-1"]
    with pytest.raises(Refusal, match=f"no {service} is running") as caught:
        made.open(opening(), b"client", 0.0)
    assert caught.value.code == "no-service"


def test_a_name_is_taken_once() -> None:
    made = registry()
    made.open(opening("demo"), b"one", 0.0)
    with pytest.raises(Refusal) as caught:
        made.open(opening("demo"), b"two", 0.0)
    assert caught.value.code == "session-exists"


def test_there_is_a_limit() -> None:
    made = registry(max_sessions=1)
    made.open(opening(), b"one", 0.0)
    with pytest.raises(Refusal) as caught:
        made.open(opening(), b"two", 0.0)
    assert caught.value.code == "too-many-sessions"


def test_only_the_token_opens_the_door() -> None:
    made = registry()
    record = made.open(opening("demo"), b"one", 0.0)
    assert made.owned("demo", record.token) is record
    with pytest.raises(Refusal) as caught:
        made.owned("demo", "guess")
    assert caught.value.code == "bad-token"
    with pytest.raises(Refusal) as caught:
        made.owned("other", record.token)
    assert caught.value.code == "unknown-session"


def test_sessions_go_to_the_least_loaded() -> None:
    made = registry()
    made.beat(heartbeat("recognizer", "recognizer-2"), b"r2", 0.0)
    used = [made.open(opening(), b"client", 0.0).recognizer for _ in range(4)]
    assert sorted(used) == ["recognizer-1", "recognizer-1", "recognizer-2", "recognizer-2"]


def test_a_draining_service_gets_nothing_new() -> None:
    made = registry()
    made.beat(heartbeat("recognizer", "recognizer-2"), b"r2", 0.0)
    made.beat(heartbeat("recognizer", "recognizer-1", state="draining"), b"r1", 0.0)
    assert made.open(opening(), b"client", 0.0).recognizer == "recognizer-2"


def test_silence_is_noticed_after_the_limit() -> None:
    made = registry()
    made.beat(heartbeat("recognizer", "recognizer-1"), b"r1", 2.5)
    assert made.silent(2.9) == []
    assert made.silent(3.1) == ["synthesizer-1"]


def test_a_lost_recognizer_is_replaced_with_a_greater_epoch() -> None:
    made = registry()
    record = made.open(opening(), b"client", 0.0)
    del made.services["recognizer-1"]
    assert not made.replace(record, 1.0)
    made.beat(heartbeat("recognizer", "elsewhere"), b"r2", 1.0)
    assert not made.replace(record, 1.0), "the client goes on sending to where it was told to"
    again = dataclasses.replace(heartbeat("recognizer", "recognizer-1"), instance="recognizer-2")
    made.beat(again, b"r3", 1.0)
    assert made.replace(record, 1.0)
    assert (record.recognizer, record.synthesizer, record.epoch) == (
        "recognizer-2",
        "synthesizer-1",
        2,
    )


def test_a_service_at_the_same_endpoint_displaces_the_one_that_crashed() -> None:
    made = registry()
    old = made.services["recognizer-1"].heartbeat
    again = Heartbeat(
        service="recognizer", instance="recognizer-9", state="ready", sent_ns=0,
        endpoints=old.endpoints,
    )  # fmt: skip
    assert made.displaced_by(again) == ["recognizer-1"]
