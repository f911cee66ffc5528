"""The recognizer's loop in one process: how much it does at a time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from services.recognizer.service import MOST_WAITING_S, RecognizerService
from shared.config import RecognizerConfig
from shared.messages import MAX_AUDIO_BYTES, AudioChunk, StartSession
from tests.system import free_port

pytestmark = pytest.mark.unit
RATE_HZ = 8000


class Watched(RecognizerService):
    """Notes the media time of the session whenever a heartbeat may leave."""

    def __init__(self) -> None:
        local = "tcp://127.0.0.1:*"
        nobody = f"tcp://127.0.0.1:{free_port()}"
        super().__init__(RecognizerConfig(control=nobody, audio=local, phones=local))
        self.heard: list[int] = [0]

    def beat_if_due(self) -> None:
        self.heard += [stream.media_time for stream in self._streams.values()]


@pytest.fixture
def service() -> Iterator[Watched]:
    made = Watched()
    yield made
    made.bus.close()


def test_the_longest_chunk_is_heard_in_pieces_with_heartbeats_between(service: Watched) -> None:
    start = StartSession(
        session="s",
        epoch=1,
        request="r",
        token="t",
        encoding="s16le",
        sample_rate_hz=RATE_HZ,
        num_channels=1,
        record=False,
        paced=False,
        phone_input=f"tcp://127.0.0.1:{free_port()}",
        phones="",
        faps="",
    )
    service.start_session(start)
    pcm = bytes(MAX_AUDIO_BYTES)
    service._on_audio(AudioChunk(session="s", token="t", sequence=1, pcm=pcm), b"")
    service._hear_waiting()
    service.beat_if_due()
    steps = [
        after - before for before, after in zip(service.heard, service.heard[1:], strict=False)
    ]
    assert max(steps) <= MOST_WAITING_S * 16000 + 320
    assert service.heard[-1] == pytest.approx(MAX_AUDIO_BYTES, abs=320)  # 2 bytes at half the rate
