"""Streams audio to a running system, in real time or as fast as it is taken."""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from kouxing.shared.audio_file import AudioSource, clipping_remarks, num_clipped
from kouxing.shared.bus import Socket
from kouxing.shared.client import Client, Session, Subscription
from kouxing.shared.clock import to_seconds
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory
from kouxing.shared.wire.control import Event
from kouxing.shared.wire.face import EndOfFaps, FapFrame
from kouxing.shared.wire.speech import Phone

QUEUE_WAIT_S = 0.005
END_LIMIT_S = 30.0  # for the last frames after the last sample
STATUS_S = 1.0  # between questions to control
DRIVER_LIMIT_S = 20.0  # for a driver to be back that was lost, as on a busy machine
PIPE_PAUSE_S = 0.2  # without sound; then a pipe's next sound is not late, but comes after a pause
PIPE_CLOCK = 0.999  # so that a pipe from a device whose clock is fast does not fill
QUIET_PEAK = 1e-3  # below this (-60 dBFS) a file is called silent


@dataclass(frozen=True, slots=True)
class StreamSummary:
    """Result of streaming one source."""

    session: str
    duration_s: float
    num_phones: int
    video: str  # path on the driver's host, empty if none was recorded


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

    ``mouth_profile`` is the content of the speaker's mouth profile, if any.

    Raises
    ------
    UserError
        If the system does not answer, refuses the session or stops answering.
    """
    with Client(control) as client:
        drawn_before_s = _drawn_s(client) if record else 0.0
        opened = client.open_session(
            session=session,
            encoding="f32le",
            sample_rate_hz=source.sample_rate_hz,
            num_channels=source.num_channels,
            record=record,
            paced=paced,
            mouth_profile=mouth_profile or None,
        )
        output = opened.subscribe(EndOfFaps, FapFrame)
        phones = opened.subscribe(Phone)
        events = client.bus.connect_subscriber(opened.opened.events)
        events.subscribe(Event, opened.name)
        try:
            with _progress(console) as progress:
                face = _Face(output, progress, f"speaking {source.name}", source.duration_s)
                duration_s, clipped, peak = _send_all(
                    source, opened, face, events, console, paced=paced
                )
                _send_with_retry(opened.finish)
                _wait_for_end(face, opened, events, console, client)
            num_phones = _count_phones(
                phones, load_inventory(opened.opened.facts.language or DEFAULT_LANGUAGE).silence
            )
        finally:
            with contextlib.suppress(UserError):  # closed already, or control is gone
                opened.close()
        video = ""
        if record:
            video = _wait_for_video(events, console, client, drawn_before_s, duration_s)
    if num_phones == 0:
        reason = "it is silent" if peak < QUIET_PEAK else "is there a voice in it?"
        _warn(console, f"{source.name}: no speech was found; {reason}")
    for remark in (*source.remarks, *clipping_remarks(source.name, clipped)):
        _warn(console, remark)
    return StreamSummary(opened.name, duration_s, num_phones, video)


class _Face:
    """The FAP frames that come back, and a bar of how far they are."""

    def __init__(
        self, output: Subscription, progress: Progress, title: str, duration_s: float | None
    ) -> None:
        self.has_ended = False
        self._output = output
        self._progress = progress
        self._task = progress.add_task(title, total=duration_s)

    def update(self, timeout_s: float) -> None:
        """Take what comes, waiting up to the timeout for the first of it."""
        if not self._output.wait(timeout_s):
            return
        for received in self._output.receive():
            if isinstance(received.message, EndOfFaps):
                self.has_ended = True
            elif isinstance(received.message, FapFrame):
                time_s = to_seconds(received.message.media_time)
                self._progress.update(self._task, completed=time_s)


def _progress(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    is_shown = console.is_interactive
    return Progress(*columns, console=console, transient=True, disable=not is_shown)


def _send_all(
    source: AudioSource,
    session: Session,
    face: _Face,
    events: Socket,
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
            _send_with_retry(functools.partial(session.send, block))
            num_sent += len(block)
            clipped += num_clipped(block)
            peak = max(peak, float(np.abs(block).max()))
            face.update(0.0)
            _check_errors(session, events, console)
            if paced and not source.is_live:
                if is_pipe and time.monotonic() > due_s + PIPE_PAUSE_S:
                    due_s = time.monotonic()  # it goes on after a pause
                due_s += len(block) / source.sample_rate_hz * (PIPE_CLOCK if is_pipe else 1.0)
                time.sleep(max(0.0, due_s - time.monotonic()))
    except KeyboardInterrupt:
        console.print("stopping")
    duration_s = num_sent / source.sample_rate_hz
    return duration_s, clipped / max(1, num_sent * source.num_channels), peak


def _send_with_retry(send: Callable[[], bool]) -> None:
    """Repeat a send until the queue has room.

    Raises
    ------
    UserError
        If it has none for 30 s.
    """
    end_s = time.monotonic() + END_LIMIT_S
    while not send():
        if time.monotonic() > end_s:
            raise UserError(
                f"the recognizer has taken no audio for {END_LIMIT_S:g} s; is it running?"
            )
        time.sleep(QUEUE_WAIT_S)


def _wait_for_end(
    face: _Face, session: Session, events: Socket, console: Console, client: Client
) -> None:
    """Wait for the last frame; with much audio queued that may take a while.

    Raises
    ------
    UserError
        If the session is lost, or the system is gone.
    """
    ask_s = time.monotonic() + STATUS_S
    while not face.has_ended:
        face.update(0.2)
        _check_errors(session, events, console)
        if time.monotonic() > ask_s:
            client.status()
            ask_s = time.monotonic() + STATUS_S


def _check_errors(session: Session, events: Socket, console: Console) -> None:
    """Show the errors that the services report.

    Raises
    ------
    UserError
        If the session is lost.
    """
    for error in session.errors():
        _warn(console, f"{error.code}: {error.text}")
        if error.code in ("unknown-session", "bad-token", "finished"):
            raise UserError("the session was lost; speak again to open a new one")
    for received in events.receive():
        event = received.message
        if isinstance(event, Event) and event.name == "session-closed":
            raise UserError(f"the session was closed: {event.detail}")
        if isinstance(event, Event) and event.name == "error":
            _warn(console, event.detail)


def _count_phones(phones: Subscription, silence: str) -> int:
    indices: set[int] = set()
    while phones.wait(0.0):
        for received in phones.receive():
            message = received.message
            if isinstance(message, Phone) and message.symbol != silence:
                indices.add(message.index)
    return len(indices)


def _wait_for_video(
    events: Socket, console: Console, client: Client, drawn_before_s: float, duration_s: float
) -> str:
    """Wait for the driver's video, of so many seconds; return its path, empty if there is none.

    Raises
    ------
    UserError
        If the system is gone.
    """
    with _progress(console) as progress:
        task = progress.add_task("writing the video", total=duration_s)
        newest_s = drawn_before_s
        while True:
            drawn_s = _drawn_s(client, DRIVER_LIMIT_S)
            if drawn_s < newest_s:
                raise UserError("the driver was started again, so there is no video; speak again")
            newest_s = drawn_s
            progress.update(task, completed=drawn_s - drawn_before_s)
            if not events.wait(STATUS_S):
                continue
            for received in events.receive():
                event = received.message
                if isinstance(event, Event) and event.name == "recorded":
                    return event.detail
                if isinstance(event, Event) and event.detail.startswith("no-video"):
                    _warn(console, event.detail)
                    return ""


def _drawn_s(client: Client, wait_s: float = 0.0) -> float:
    """Return how many seconds of video the driver has drawn since it started.

    Raises
    ------
    UserError
        If no driver runs, nor is back within the wait.
    """
    end_s = time.monotonic() + wait_s
    while True:
        drivers = [each for each in client.status().services if each.service == "driver"]
        if drivers:
            return max(each.metrics.get("video_ms", 0.0) for each in drivers) / 1000
        if time.monotonic() >= end_s:
            raise UserError("no driver runs, so there is no video; start one: kouxing driver")
        time.sleep(STATUS_S)


def _warn(console: Console, text: str) -> None:
    console.print(text, style="yellow", markup=False, highlight=False)
