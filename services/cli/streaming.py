"""Streams audio to a running system, in real time or as fast as the system accepts it."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import numpy as np
from kouxing_client import (
    Client,
    Event,
    KouxingError,
    Phone,
    Refused,
    Results,
    Session,
)
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from kouxing.shared.audio_file import AudioSource, clipping_remarks, num_clipped
from kouxing.shared.control_client import connect
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory

PUSH_TIMEOUT_S = 30.0
STATUS_S = 1.0  # between status requests
DRIVER_TIMEOUT_S = 20.0  # for a lost driver to restart, on a busy machine
PIPE_PAUSE_S = 0.2  # a pipe that is silent for longer has paused; its next audio is not late
PIPE_CLOCK = 0.999  # so that a pipe from a device with a fast clock does not fill
QUIET_PEAK = 1e-3  # a file whose peak is lower (-60 dBFS) is called silent


@dataclass(frozen=True, slots=True)
class StreamSummary:
    """Result of streaming one source."""

    session: str
    duration_s: float
    num_phones: int
    video: str  # path on the driver's host; empty if none was recorded


def stream(
    source: AudioSource,
    control: str,
    console: Console,
    *,
    session: str = "",
    record: bool = False,
    paced: bool = True,
    mouth_profile: bytes = b"",
) -> StreamSummary:
    """Stream a source through a running system and wait for its last FAP frame.

    ``mouth_profile`` is the speaker's, if any. Raises ``UserError`` if the system does not answer,
    refuses the session or stops answering.
    """
    with connect(control) as client:
        drawn_before_s = _drawn_s(client) if record else 0.0
        opened = client.open_session(
            session,
            encoding="f32le",
            sample_rate_hz=source.sample_rate_hz,
            num_channels=source.num_channels,
            record=record,
            paced=paced,
            mouth_profile=mouth_profile or None,
        )
        events = opened.events()
        silence = load_inventory(opened.info["facts"]["language"] or DEFAULT_LANGUAGE).silence
        try:
            with _progress(console) as progress:
                title = f"speaking {source.name}"
                output = _Output(opened, progress, title, source.duration_s, silence)
                duration_s, clipped, peak = _send_all(
                    source, opened, output, events, console, paced=paced
                )
                opened.finish()
                _wait_for_end(output, opened, events, console, client)
        finally:
            with contextlib.suppress(KouxingError):  # closed already, or control is gone
                opened.close()
        video = ""
        if record:
            video = _wait_for_video(events, console, client, drawn_before_s, duration_s)
    num_phones = len(output.phones)
    if num_phones == 0:
        reason = "it is silent" if peak < QUIET_PEAK else "is there a voice in it?"
        _warn(console, f"{source.name}: no speech was found; {reason}")
    for remark in (*source.remarks, *clipping_remarks(source.name, clipped)):
        _warn(console, remark)
    return StreamSummary(opened.name, duration_s, num_phones, video)


class _Output:
    """The phones and FAP frames of the session, and a progress bar of the frames."""

    def __init__(
        self,
        session: Session,
        progress: Progress,
        title: str,
        duration_s: float | None,
        silence: str,
    ) -> None:
        self.phones: set[int] = set()  # indices of those that are not silence
        self._silence = silence
        self._frames = session.frames()
        self._phones = session.results(Phone, keep_all=True)
        self._progress = progress
        self._task = progress.add_task(title, total=duration_s)

    @property
    def has_ended(self) -> bool:
        return self._frames.has_ended

    def update(self, timeout_s: float) -> None:
        """Process what has arrived, waiting up to the timeout for a frame."""
        for frame in self._frames.available(timeout_s):
            self._progress.update(self._task, completed=frame.time_s)
        for phone in self._phones.available():
            if phone.symbol != self._silence:
                self.phones.add(phone.index)


def _progress(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    is_shown = console.is_interactive
    return Progress(*columns, console=console, transient=True, disable=not is_shown)


def _send_all(
    source: AudioSource,
    session: Session,
    output: _Output,
    events: Results[Event],
    console: Console,
    *,
    paced: bool,
) -> tuple[float, float, float]:
    """Send everything; return seconds sent, the share of clipped samples and the peak."""
    num_sent = clipped = 0
    peak = 0.0
    is_pipe = source.duration_s is None
    due_s = time.monotonic()  # when the next block is spoken
    try:
        for block in source.blocks:
            _check_errors(session, events, console)
            with contextlib.suppress(Refused):  # `_check_errors` reports the next one
                session.push(block.astype("<f4").tobytes(), PUSH_TIMEOUT_S)
            num_sent += len(block)
            clipped += num_clipped(block)
            peak = max(peak, float(np.abs(block).max()))
            output.update(0.0)
            if paced and not source.is_live:
                if is_pipe and time.monotonic() > due_s + PIPE_PAUSE_S:
                    due_s = time.monotonic()  # it resumes after a pause
                due_s += len(block) / source.sample_rate_hz * (PIPE_CLOCK if is_pipe else 1.0)
                time.sleep(max(0.0, due_s - time.monotonic()))
    except KeyboardInterrupt:
        console.print("stopping")
    duration_s = num_sent / source.sample_rate_hz
    return duration_s, clipped / max(1, num_sent * source.num_channels), peak


def _wait_for_end(
    output: _Output, session: Session, events: Results[Event], console: Console, client: Client
) -> None:
    """Wait for the last frame; with much queued audio that may take a while."""
    ask_s = time.monotonic() + STATUS_S
    while not output.has_ended:
        output.update(0.2)
        _check_errors(session, events, console)
        if time.monotonic() > ask_s:
            client.status()
            ask_s = time.monotonic() + STATUS_S


def _check_errors(session: Session, events: Results[Event], console: Console) -> None:
    """Print the errors that the services report."""
    try:
        errors = session.take_errors()
    except Refused as refusal:
        errors = [refusal]
    for error in errors:
        _warn(console, str(error))
        if error.code in ("unknown-session", "bad-token", "finished"):
            raise UserError("the session was lost; speak again to open a new one")
    for event in events.available():
        if event.name == "error":
            _warn(console, event.detail)


def _wait_for_video(
    events: Results[Event],
    console: Console,
    client: Client,
    drawn_before_s: float,
    duration_s: float,
) -> str:
    """Wait for the driver's video of ``duration_s``; return its path, or an empty string."""
    with _progress(console) as progress:
        task = progress.add_task("writing the video", total=duration_s)
        newest_s = drawn_before_s
        while True:
            drawn_s = _drawn_s(client, DRIVER_TIMEOUT_S)
            if drawn_s < newest_s:
                raise UserError("the driver restarted, so there is no video; speak again")
            newest_s = drawn_s
            progress.update(task, completed=drawn_s - drawn_before_s)
            for event in events.available(STATUS_S):
                if event.name == "recorded":
                    return event.detail
                if event.detail.startswith("no-video"):
                    _warn(console, event.detail)
                    return ""


def _drawn_s(client: Client, timeout_s: float = 0.0) -> float:
    """Return how many seconds of video the driver has drawn since it started."""
    end_s = time.monotonic() + timeout_s
    while True:
        drivers = [state for state in client.status().services if state.service == "driver"]
        if drivers:
            return max(state.metrics.get("video_ms", 0.0) for state in drivers) / 1000
        if time.monotonic() >= end_s:
            raise UserError("no driver runs, so there is no video; start one: kouxing driver")
        time.sleep(STATUS_S)


def _warn(console: Console, text: str) -> None:
    console.print(text, style="yellow", markup=False, highlight=False)
