"""The sample sentence is sent as it is in its file, and can be played again at once."""

import asyncio
import contextlib
import wave
from collections.abc import AsyncIterator
from typing import cast

from kouxing_client import Refused

from kouxing.services.gateway.audio.audio_sessions import LAST_FRAME_TIMEOUT_S, AudioClient
from kouxing.services.gateway.audio.sample_sentence import SAMPLE_FILE, SampleSentence
from tests.fake_time import with_fake_time


class FakeSession:
    """Collects audio."""

    is_closed = False

    def __init__(self, error: str) -> None:
        self.pcm = b""
        self._error = error

    def send(self, pcm: bytes, num_frames: int) -> None:
        assert len(pcm) == 2 * num_frames
        self.pcm += pcm

    def take_errors(self) -> list[Refused]:
        return [Refused("overload", self._error)] if self._error else []


class FakeClient:
    """Opens sessions, whose last frames take a while."""

    def __init__(self, error: str = "") -> None:
        self.error = error
        self.sessions: dict[str, FakeSession] = {}
        self.is_finishing = asyncio.Event()

    @contextlib.asynccontextmanager
    async def open(self, *, session: str, **options: object) -> AsyncIterator[FakeSession]:
        assert options["num_channels"] == 1
        self.sessions[session] = FakeSession(self.error)
        try:
            yield self.sessions[session]
        finally:
            self.is_finishing.set()
            await asyncio.sleep(LAST_FRAME_TIMEOUT_S)


class Ends:
    """Collects the sessions that have ended, and their errors."""

    def __init__(self, num_expected: int) -> None:
        self.sessions: list[str] = []
        self.errors: list[str] = []
        self.all = asyncio.Event()
        self._num_expected = num_expected

    def add(self, session: str, error: str) -> None:
        self.sessions.append(session)
        self.errors.append(error)
        if len(self.sessions) == self._num_expected:
            self.all.set()


def make_sample(client: FakeClient) -> SampleSentence:
    sample = SampleSentence(cast("AudioClient", client))
    sample.characters = (("你", ("n", "i")),)  # loading them needs a thread
    return sample


@with_fake_time
async def test_the_samples_of_the_file_are_sent_unchanged() -> None:
    client, ends = FakeClient(), Ends(1)
    make_sample(client).play("", ends.add)
    await ends.all.wait()
    (session,) = client.sessions.values()
    with wave.open(str(SAMPLE_FILE)) as file:
        assert file.getsampwidth() == 2
        assert session.pcm == file.readframes(file.getnframes())


@with_fake_time
async def test_the_sentence_can_be_played_again_while_its_last_frames_are_shown() -> None:
    client, ends = FakeClient(), Ends(2)
    sample = make_sample(client)
    sample.play("", ends.add)
    first = sample.session
    sample.play("", ends.add)
    assert sample.session == first, "it is being spoken"
    await client.is_finishing.wait()
    assert sample.open_sessions == [first]
    sample.play("", ends.add)
    assert sample.open_sessions == [first, sample.session]
    await ends.all.wait()
    assert ends.sessions == [*client.sessions]
    assert len({*ends.sessions}) == 2
    assert (sample.session, sample.open_sessions) == ("", [])


@with_fake_time
async def test_an_error_of_the_recognizer_is_reported() -> None:
    ends = Ends(1)
    make_sample(FakeClient("too busy")).play("", ends.add)
    await ends.all.wait()
    assert "too busy" in ends.errors[0]
