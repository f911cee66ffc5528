"""Several sessions of one recognizer, without control."""

from collections.abc import Iterator

import numpy as np
import pytest
from kouxing_client.messages import Message

from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.service import MAX_TICK_S, RecognizerService
from kouxing.services.recognizer.sessions.session import STALLED_AFTER_S
from kouxing.shared.fast_record import replace
from kouxing.shared.wire.speech import AudioState, Progress
from tests.samples import START
from tests.system import free_port

LOCAL = "tcp://127.0.0.1:*"


@pytest.fixture
def service() -> Iterator[RecognizerService]:
    service = RecognizerService(
        RecognizerConfig(
            audio=LOCAL,
            phones=LOCAL,
            unpaced_audio=LOCAL,
            control=f"tcp://127.0.0.1:{free_port()}",
            insecure=True,
            acoustic="light",
        )
    )
    yield service
    service.bus.close()


def test_reports_a_stalled_client_while_others_send_audio(
    service: RecognizerService, monkeypatch: pytest.MonkeyPatch
) -> None:
    stalled: list[str] = []
    endpoints = {"phone_input": f"tcp://127.0.0.1:{free_port()}"}
    for name in ("silent", "sending", "decoding"):
        service.start_session(replace(START, session=name, endpoints=endpoints))

        def record(message: Message, _now_s: float, name: str = name) -> None:
            if isinstance(message, Progress) and message.state == AudioState.STALLED:
                stalled.append(name)

        monkeypatch.setattr(service._sessions[name].link, "send", record)
    start_s = service._last_stall_check_s
    service._sessions["sending"].audio.append((0, np.zeros((320, 1), np.float32)), start_s)
    service._sessions["decoding"].is_scoring = True
    for number in range(1, round(STALLED_AFTER_S / MAX_TICK_S) + 2):
        service._report_stalled(start_s + number * MAX_TICK_S)
    assert stalled == ["silent"]
    service._sessions["decoding"].is_scoring = False
    service._report_stalled(start_s + 1.0)
    assert stalled == ["silent"], "the time of decoding does not count"
