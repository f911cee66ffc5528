"""``speak`` handles the events about its session's video."""

import io
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
from kouxing_client.messages import Event, Phone
from rich.console import Console

from kouxing.services.cli.system import streaming
from kouxing.shared.audio.audio_file import AudioSource
from kouxing.shared.command import terminal

SHORT = Event(session="s", name="error", detail="short-video: too many frames")
FAILED = Event(session="s", name="error", detail="no-video: no encoder")
RECORDED = Event(session="s", name="recorded", detail="out/s.mp4")


def make_session(reads: list[list[Event]]) -> Any:
    """Return a session without audio and results; each read of its events returns the next ones."""
    phones = SimpleNamespace(num_missed=0, has_ended=False)

    def read_phones(_timeout_s: float) -> list[Phone]:
        phones.has_ended = True
        return []

    phones.available = read_phones
    session = mock.Mock(results=lambda *_, **__: phones)
    session.name = "s"
    session.frames().available.return_value = []
    session.take_errors.return_value = []
    session.events = lambda: SimpleNamespace(available=lambda _timeout_s=0.0: reads.pop(0))
    return session


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
    output = io.StringIO()
    monkeypatch.setattr(terminal, "CONSOLE", Console(file=output, width=200))
    problems = [event.detail for read in reads for event in read if event.name == "error"]
    streamer = streaming._Streamer(
        mock.Mock(),
        make_session(reads[:]),
        source,
        is_recorded=True,
    )
    streamer.run(paced=False)
    assert streamer.summarize(0.0).video == video
    assert all(problem in output.getvalue() for problem in problems)
