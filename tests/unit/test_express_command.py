"""``kouxing express`` changes faces whose sessions may close at any time."""

import contextlib
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from kouxing_client import Refused

from kouxing.services.cli.system.commands import express
from kouxing.shared.command import client_connection


class FakeClient:
    """A client of a system with two sessions, one of which closes before its face changes."""

    def __init__(self, code: str) -> None:
        self.code = code
        self.changed: list[str] = []

    def status(self) -> SimpleNamespace:
        sessions = [SimpleNamespace(session=name) for name in ("gone", "open")]
        return SimpleNamespace(sessions=sessions)

    def set_face(self, session: str, **_: object) -> None:
        if session == "gone":
            raise Refused(self.code, "no session gone")
        self.changed.append(session)


def connect(monkeypatch: pytest.MonkeyPatch, code: str) -> FakeClient:
    client = FakeClient(code)

    @contextlib.contextmanager
    def connect_client(_: str) -> Iterator[FakeClient]:
        yield client

    monkeypatch.setattr(client_connection, "connect_client", connect_client)
    return client


def test_a_session_that_closes_does_not_keep_other_faces_from_changing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    client = connect(monkeypatch, "unknown-session")
    express(["joy=0.4"], control="tcp://127.0.0.1:1")
    assert client.changed == ["", "open"]
    assert capsys.readouterr().err.endswith("for 3 s: open, the face at rest\n")


@pytest.mark.parametrize(
    ("code", "arguments"), [("unknown-session", ["gone", "joy=1"]), ("not-allowed", ["joy=1"])]
)
def test_other_rejections_are_errors(
    monkeypatch: pytest.MonkeyPatch, code: str, arguments: list[str]
) -> None:
    connect(monkeypatch, code)
    with pytest.raises(Refused):
        express(arguments, control="tcp://127.0.0.1:1")
