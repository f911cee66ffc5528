"""Sessions that wait for their acoustic model, if loading it fails."""

import threading

import pytest
from kouxing_client.messages import SessionFacts

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.sessions import pending_sessions
from kouxing.services.recognizer.sessions.pending_sessions import PendingSessions
from kouxing.shared.errors import StartFailure, UserError
from kouxing.shared.fast_record import replace
from tests.samples import START
from tests.system import LIMIT_S

GERMAN = replace(START, session="first", facts=SessionFacts(language="german"))


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (UserError("no such model"), "bad-language", "no such model"),
        (OSError("bad disk"), "no-service", "the acoustic model for german cannot be .*: bad disk"),
        (MemoryError(), "no-service", "cannot be loaded: not enough memory"),
    ],
)
def test_a_model_is_loaded_again_after_a_failure(
    error: Exception, code: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_load, loaded = threading.Semaphore(0), threading.Semaphore(0)
    errors = [error]

    def load(_language: str) -> AcousticModel | None:
        assert may_load.acquire(timeout=LIMIT_S)
        if errors:
            raise errors.pop()
        return None

    monkeypatch.setattr(pending_sessions, "load_model_for_language", load)
    pending = PendingSessions("mandarin", loaded.release)
    second = replace(GERMAN, session="second")
    assert pending.add(GERMAN)
    assert pending.add(second)
    may_load.release()
    assert loaded.acquire(timeout=LIMIT_S)
    with pytest.raises(StartFailure, match=text) as failure:
        pending.add(replace(GERMAN, session="third"))
    assert failure.value.code == code
    assert pending.take_ready() == [GERMAN, second]  # they try again
    assert pending.add(second)
    assert pending.take_ready() == []
    may_load.release()
    assert loaded.acquire(timeout=LIMIT_S)
    assert pending.take_ready() == [second]
    assert not pending.add(second)
