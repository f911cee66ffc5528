"""An answer is repeated to whom it belongs, and its token to nobody else."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.keys import user_key
from shared.wire.session import SessionOpened
from tests.control_stage import Stage

pytestmark = pytest.mark.unit


@pytest.fixture(params=[True, False])
def stage(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Stage]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    made = Stage(insecure=request.param)
    yield made
    made.close()


def test_a_request_that_is_repeated_has_the_same_answer(stage: Stage) -> None:
    client = stage.stranger(stage.control.key and user_key())
    first = stage.open(client, "mine")
    assert isinstance(first, SessionOpened)
    assert stage.open(client, "mine") == first


def test_whoever_takes_anothers_name_and_key_gets_no_answer_of_it(stage: Stage) -> None:
    key = stage.control.key and user_key()
    assert isinstance(stage.open(stage.stranger(key), "mine"), SessionOpened)
    stolen = stage.open(stage.stranger(key), "mine")
    assert getattr(stolen, "code", "") == "session-exists"
