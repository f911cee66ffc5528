"""The sample sentence is sent as it is in its file."""

import contextlib
import wave
from collections.abc import AsyncIterator
from typing import cast

from kouxing.services.gateway.audio.audio_sessions import AudioClient
from kouxing.services.gateway.audio.sample_sentence import SAMPLE_FILE, SampleSentence
from tests.fake_time import with_fake_time


class FakeSession:
    """Collects audio."""

    is_closed = False

    def __init__(self) -> None:
        self.pcm = b""

    def send(self, pcm: bytes, num_frames: int) -> None:
        assert len(pcm) == 2 * num_frames
        self.pcm += pcm


class FakeClient:
    """Opens one session."""

    def __init__(self) -> None:
        self.session = FakeSession()

    @contextlib.asynccontextmanager
    async def open(self, **options: object) -> AsyncIterator[FakeSession]:
        assert options["num_channels"] == 1
        yield self.session


@with_fake_time
async def test_the_samples_of_the_file_are_sent_unchanged() -> None:
    client = FakeClient()
    await SampleSentence(cast("AudioClient", client))._speak()
    with wave.open(str(SAMPLE_FILE)) as file:
        assert file.getsampwidth() == 2
        assert client.session.pcm == file.readframes(file.getnframes())
