"""``speak`` handles the events about its session's video."""

import io
from collections.abc import Iterator
from typing import Any

import pytest
from kouxing_client.messages import Event
from rich.console import Console

from kouxing.services.cli.system import streaming
from kouxing.shared.audio.audio_file import AudioSource

SHORT = Event(session="s", name="error", detail="short-video: too many frames")
FAILED = Event(session="s", name="error", detail="no-video: no encoder")
RECORDED = Event(session="s", name="recorded", detail="out/s.mp4")


class FakeSession:
    """A session without audio. Each read returns the next events."""

    name = "s"

    def __init__(self, *reads: list[Event]) -> None:
        self._reads = list(reads)

    def events(self) -> "FakeSession":
        return self

    def frames(self) -> "FakeResults":
        return FakeResults()

    def results(self, *_classes: type, **_options: object) -> "FakeResults":
        return FakeResults()

    def available(self, _timeout_s: float = 0.0) -> Iterator[Event]:
        yield from self._reads.pop(0)

    def take_errors(self) -> list[Any]:
        return []

    def finish(self) -> None:
        """End no audio."""


class FakeResults:
    """No results."""

    num_missed = 0
    has_ended = False

    def available(self, _timeout_s: float = 0.0) -> Iterator[Event]:
        self.has_ended = True
        return iter(())


@pytest.mark.parametrize(
    ("reads", "video"),
    [
        ([[SHORT], [], [RECORDED]], "out/s.mp4"),
        ([[SHORT, RECORDED]], "out/s.mp4"),
        ([[], [SHORT], [RECORDED]], "out/s.mp4"),
        ([[FAILED]], ""),
        ([[], [FAILED]], ""),
    ],
)
def test_waits_for_a_video_that_ends_early(
    reads: list[list[Event]], video: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streaming, "_drawn_s", lambda *_: 0.0)
    source = AudioSource("silence", 16_000, 1, 0.0, iter(()))
    console = Console(file=io.StringIO(), width=200)
    client: Any = None
    session: Any = FakeSession(*reads)
    streamer = streaming._Streamer(client, session, source, console, is_recorded=True)
    streamer.run(paced=False)
    assert streamer.summarize(0.0).video == video
    problems = [event.detail for read in reads for event in read if event.name == "error"]
    assert isinstance(console.file, io.StringIO)
    assert all(problem in console.file.getvalue() for problem in problems)
