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

from shared.audio_file import AudioSource, clipping_remarks, num_clipped
from shared.bus import Socket
from shared.client import Client, Session, Subscription
from shared.errors import UserError
from shared.phones.inventory import load_inventory
from shared.wire.control import Event
from shared.wire.face import EndOfFaps
from shared.wire.speech import Phone

QUEUE_WAIT_S = 0.005
END_LIMIT_S = 30.0  # for the last frames after the last sample
VIDEO_LIMIT_S = 3600.0
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
    voice: bytes = b"",
) -> StreamSummary:
    """Stream a source through a running system and wait for its last FAP frame.

    ``voice`` is the profile of the speaker's voice, if any.

    Raises
    ------
    UserError
        If the system does not answer, refuses the session or stops answering.
    """
    with Client(control) as client:
        opened = client.open_session(
            session=session,
            encoding="f32le",
            sample_rate_hz=source.sample_rate_hz,
            num_channels=source.num_channels,
            record=record,
            paced=paced,
            voice=voice,
        )
        output = opened.subscribe(EndOfFaps)
        phones = opened.subscribe(Phone)
        events = client.bus.connect_subscriber(opened.opened.events)
        events.subscribe(Event, opened.name)
        try:
            duration_s, clipped, peak = _send_all(source, opened, events, console, paced=paced)
            _send_with_retry(opened.finish)
            _wait_for_end(output, opened, events, console)
            num_phones = _count_phones(phones, load_inventory(opened.opened.language).silence)
        finally:
            with contextlib.suppress(UserError):  # closed already, or control is gone
                opened.close()
        video = _wait_for_video(events, console) if record else ""
    if num_phones == 0:
        reason = "it is silent" if peak < QUIET_PEAK else "is there a voice in it?"
        _warn(console, f"{source.name}: no speech was found; {reason}")
    for remark in (*source.remarks, *clipping_remarks(source.name, clipped)):
        _warn(console, remark)
    return StreamSummary(opened.name, duration_s, num_phones, video)


def _send_all(
    source: AudioSource, session: Session, events: Socket, console: Console, *, paced: bool
) -> tuple[float, float, float]:
    """Send everything; return seconds sent, the share of clipped samples and the peak."""
    num_sent = clipped = 0
    peak = 0.0
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(f"speaking {source.name}", total=source.duration_s)
        begin_s = time.monotonic()
        try:
            for block in source.blocks:
                _send_with_retry(functools.partial(session.send, block))
                num_sent += len(block)
                clipped += num_clipped(block)
                peak = max(peak, float(np.abs(block).max()))
                sent_s = num_sent / source.sample_rate_hz
                progress.update(task, completed=sent_s)
                _check_errors(session, events, console)
                if paced and source.duration_s is not None:
                    time.sleep(max(0.0, begin_s + sent_s - time.monotonic()))
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


def _wait_for_end(output: Subscription, session: Session, events: Socket, console: Console) -> None:
    """Wait for the last frame; with much audio queued that may take a while."""
    while True:
        if output.wait(0.2) and any(isinstance(r.message, EndOfFaps) for r in output.receive()):
            return
        _check_errors(session, events, console)


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


def _wait_for_video(events: Socket, console: Console) -> str:
    end_s = time.monotonic() + VIDEO_LIMIT_S
    with console.status("writing the video"):
        while time.monotonic() < end_s:
            if not events.wait(0.2):
                continue
            for received in events.receive():
                event = received.message
                if isinstance(event, Event) and event.name == "recorded":
                    return event.detail
                if isinstance(event, Event) and event.detail.startswith("no-video"):
                    _warn(console, event.detail)
                    return ""
    raise UserError("the driver wrote no video; see 'kouxing status'")


def _warn(console: Console, text: str) -> None:
    console.print(text, style="yellow", markup=False, highlight=False)
