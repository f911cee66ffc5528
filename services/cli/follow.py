"""Prints or records the output of a session: FAPs or shapes, syllables or phones."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from kouxing.services.cli.curves import (
    CURVE_EXPORTERS,
    CurveExporter,
    JsonLinesExporter,
    Row,
)
from kouxing.services.cli.options import CurveForm, ExportOptions, Shown
from kouxing.shared.client import Client, Refused
from kouxing.shared.clock import to_seconds
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS
from kouxing.shared.follower import PollingLoop, SessionFollower
from kouxing.shared.phones import events
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, PhoneInventory, load_inventory
from kouxing.shared.phones.syllables import SyllableTrack
from kouxing.shared.terminal import CONSOLE, check_output, print_message
from kouxing.shared.wire.events import phone_of
from kouxing.shared.wire.face import EndOfFaps, FapFrame
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import ErrorCode, SessionState
from kouxing.shared.wire.speech import Phone

OPEN_POLL_S = 0.2
SILENT_S = 2.0  # without messages, control is asked where the session is
PRINTED_FAPS = (3, 4, 5, 6, 16, 17)  # jaw, lips, lip corner, protrusion
LEGEND = "columns: time, then FAPs " + ", ".join(f"{n} {FAPS[n - 1].name}" for n in PRINTED_FAPS)

Followed = TypeVar("Followed", bound=Message)


def follow(session: str, output: Path | None, shown: Shown, form: CurveForm, control: str) -> None:
    """Follow a session until it ends.

    Parameters
    ----------
    session
        Its name. If empty, the newest open session, or else the next one.
    output
        File for the frames. If None, print what ``shown`` selects.
    form
        Values of the frames.

    Raises
    ------
    UserError
        If control does not answer, or the file cannot be written.
    """
    if shown is not Shown.FAPS and (output is not None or form is not CurveForm.FAPS):
        raise UserError(f"--show {shown} only prints; --output and --as are for frames")
    exporter = None if output is None else _open_exporter(output, form)
    with Client(control) as client:
        state = _wait_for_session(session, client)
        if shown is not Shown.FAPS:
            inventory = load_inventory(state.facts.language or DEFAULT_LANGUAGE)
            count = _print(_phone_lines(_messages(Phone, state, client), shown, inventory))
        else:
            rows = map(_row, _messages(FapFrame, state, client))
            count = _print_frames(rows, form) if exporter is None else exporter.write(rows)
    unit = "frames" if shown is Shown.FAPS else shown.value
    print_message(f"session {state.session} ended: {count} {unit}")
    if output is not None:
        print_message(f"wrote {output}")


def _open_exporter(output: Path, form: CurveForm) -> CurveExporter:
    exporter = CURVE_EXPORTERS.get(output.suffix.lower())
    if exporter is None:
        raise UserError(
            f"{output}: unknown format; give a name that ends in {', '.join(CURVE_EXPORTERS)}"
        )
    check_output(output)
    return exporter(output, ExportOptions(form=form))


def _wait_for_session(name: str, client: Client) -> SessionState:
    """Return an open session of that name (empty: the newest), once there is one."""
    found = find_session(name, client)
    if found is None:
        wanted = f"session {name}" if name else "a session"
        opener = f"speak my.wav --session {name}" if name else "speak my.wav"
        print_message(f"waiting for {wanted} to open, as with kouxing {opener}; Ctrl-C ends")
    while found is None:
        time.sleep(OPEN_POLL_S)
        found = find_session(name, client)
    return found


def find_session(name: str, client: Client) -> SessionState | None:
    """Return an open session that is published; None if there is none."""
    try:
        sessions = client.status(name).sessions
    except Refused as refused:
        if refused.code != ErrorCode.UNKNOWN_SESSION:
            raise
        return None
    published = [state for state in sessions if "faps" in state.endpoints]
    return min(published, key=lambda state: state.age_s, default=None)


def _messages(kind: type[Followed], state: SessionState, client: Client) -> Iterator[Followed]:
    """Yield messages, wherever the session moves, until it ends or the user interrupts."""
    messages: deque[Followed] = deque()
    loop = PollingLoop(client.bus)
    follower = SessionFollower(
        loop,
        state.session,
        {kind: messages.append, EndOfFaps: lambda _end: None},
        on_complete=lambda: print_message(f"following session {state.session}"),
    )
    endpoints = state.endpoints
    follower.start(0, endpoints)
    try:
        while not follower.has_ended:
            if not loop.step(SILENT_S):
                found = find_session(state.session, client)
                if found is None:
                    return
                if found.endpoints != endpoints:
                    endpoints = found.endpoints
                    follower.start(0, endpoints)
            while messages:
                yield messages.popleft()
    except KeyboardInterrupt:
        return


def _phone_lines(
    messages: Iterable[Phone], shown: Shown, inventory: PhoneInventory
) -> Iterator[str]:
    """Yield a line for each phone or syllable when it is final. Pauses have no line."""
    track = SyllableTrack(inventory)
    for message in messages:
        phone = phone_of(message)
        changed = track.accept(phone) if shown is Shown.SYLLABLES else [phone]
        for item in changed:
            text = item.symbol if isinstance(item, events.Phone) else item.text
            if item.final and item.duration_s > 0 and text != inventory.silence:
                yield f"{item.onset_s:9.3f} s  {item.duration_s:6.3f} s  {text}"


def _row(frame: FapFrame) -> Row:
    values = np.frombuffer(frame.values, "<f4").astype(np.float32)
    return to_seconds(frame.media_time), frame.sequence, values


def _print_frames(rows: Iterable[Row], form: CurveForm) -> int:
    """Print frames, a line for each, and return their number."""
    if form is not CurveForm.FAPS:
        return _print(JsonLinesExporter.line(row, form) for row in rows)
    CONSOLE.print(LEGEND, markup=False, highlight=False)
    return _print(
        f"{time_s:9.3f} s  " + "  ".join(f"{values[n - 1]:6.0f}" for n in PRINTED_FAPS)
        for time_s, _, values in rows
    )


def _print(lines: Iterable[str]) -> int:
    count = 0
    for line in lines:
        print(line, flush=True)
        count += 1
    return count
