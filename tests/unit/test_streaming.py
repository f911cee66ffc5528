"""``speak`` handles the events about its session's video."""

import io
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
from kouxing_client.messages import Event, Phone
from rich.console import Console

from kouxing.services.cli.system import streaming
from kouxing.shared.audio.audio_file import AudioSource
from kouxing.shared.audio.phase_cancellation import Samples
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
    streamer = streaming._Streamer(mock.Mock(), make_session(reads[:]), source, 0.0)
    streamer.run(paced=False)
    assert streamer.summarize().video == video
    assert all(problem in output.getvalue() for problem in problems)


def interrupted_blocks() -> Iterator[Samples]:
    raise KeyboardInterrupt
    yield


@pytest.mark.parametrize(
    ("reads", "printed"),
    [
        ([[], [RECORDED]], "wrote out/s.mp4"),
        ([[FAILED]], "no video was written"),
        ([[], KeyboardInterrupt], "the driver is still writing the video of session s"),
    ],
)
def test_ctrl_c_names_the_video_or_says_that_there_is_none(
    reads: list[Any], printed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streaming, "_drawn_s", lambda *_: 0.0)
    output = io.StringIO()
    monkeypatch.setattr(terminal, "CONSOLE", Console(file=output, width=200))
    session = make_session([])
    session.events = lambda: mock.Mock(available=mock.Mock(side_effect=reads))
    source = AudioSource("speech", 16_000, 1, 9.0, interrupted_blocks())
    streamer = streaming._Streamer(mock.Mock(), session, source, 0.0)
    with pytest.raises(KeyboardInterrupt):
        streamer.run(paced=False)
    session.close.assert_called_once()
    assert output.getvalue().splitlines()[-1] == printed


def test_ctrl_c_ends_at_once_without_a_recording() -> None:
    session = make_session([])
    source = AudioSource("speech", 16_000, 1, 9.0, interrupted_blocks())
    with pytest.raises(KeyboardInterrupt):
        streaming._Streamer(mock.Mock(), session, source, None).run(paced=False)
    session.close.assert_not_called()
