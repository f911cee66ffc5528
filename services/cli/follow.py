"""Prints or records what a session shows: FAPs or shapes, syllables or phones."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, TypeVar

import numpy as np
from numpy.typing import NDArray

from kouxing.services.cli.curves import check_curves, row_writer
from kouxing.services.cli.options import CurveForm, Shown
from kouxing.shared.client import Client, Refused
from kouxing.shared.clock import to_seconds
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import FapAnimation, write_fap
from kouxing.shared.face.faps import FAPS, NUM_FAPS
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
SHOWN_FAPS = (3, 4, 5, 6, 16, 17)  # of a printed frame: jaw, lips, corner, protrusion
LEGEND = "the columns, FAPs: " + ", ".join(f"{n} {FAPS[n - 1].name}" for n in SHOWN_FAPS)

Followed = TypeVar("Followed", bound=Message)


def follow(session: str, output: Path | None, shown: Shown, form: CurveForm, control: str) -> None:
    """Follow a session from now on to its end.

    Parameters
    ----------
    session
        Its name; empty: the newest that is open, or else the next.
    output
        File for the frames; None: print what ``shown`` says.
    form
        What the values of frames are.

    Raises
    ------
    UserError
        If control does not answer or the file cannot be written.
    """
    _check(output, shown, form)
    with Client(control) as client:
        state = _wait_for_session(session, client)
        session = state.session
        try:
            if shown is not Shown.FAPS:
                inventory = load_inventory(state.facts.language or DEFAULT_LANGUAGE)
                num_lines = _print(_phone_rows(_messages(Phone, state, client), shown, inventory))
            else:
                num_lines = _take_frames(_messages(FapFrame, state, client), session, output, form)
        except OSError as error:
            raise UserError(f"{output}: cannot be written: {error.strerror}") from None
    unit = "frames" if shown is Shown.FAPS else shown.value
    print_message(f"session {session} ended: {num_lines} {unit}")
    if output is not None:
        print_message(f"wrote {output}")


def _check(output: Path | None, shown: Shown, form: CurveForm) -> None:
    """Refuse what does not fit together."""
    if shown is not Shown.FAPS and (output is not None or form is not CurveForm.FAPS):
        raise UserError(f"--show {shown} is for the terminal; --output and --as take frames")
    if output is not None and output.suffix not in (".fap", ".csv", ".jsonl"):
        raise UserError(f"{output}: unknown kind of file; write to .fap, .csv or .jsonl")
    check_output(output)
    if output is not None:
        check_curves(output, form)


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


def _phone_rows(
    messages: Iterable[Phone], shown: Shown, inventory: PhoneInventory
) -> Iterator[str]:
    """Yield a line for each phone or syllable once it is final; pauses have none."""
    track = SyllableTrack(inventory)
    for message in messages:
        phone = phone_of(message)
        changed = track.accept(phone) if shown is Shown.SYLLABLES else [phone]
        for each in changed:
            text = each.symbol if isinstance(each, events.Phone) else each.text
            if each.final and each.duration_s > 0 and text != inventory.silence:
                yield f"{each.onset_s:9.3f} s  {each.duration_s:6.3f} s  {text}"


def _take_frames(
    frames: Iterator[FapFrame], session: str, output: Path | None, form: CurveForm
) -> int:
    """Print or record frames; return their number."""
    if output is None and form is CurveForm.FAPS:
        CONSOLE.print(LEGEND, markup=False, highlight=False)
        return _print(map(_as_row, frames))
    if output is None:
        return _write_rows(frames, sys.stdout, ".jsonl", form)
    if output.suffix == ".fap":
        return _write_fap(output, session, list(frames))
    with output.open("w", encoding="utf-8", newline="") as file:
        return _write_rows(frames, file, output.suffix, form)


def _print(lines: Iterable[str]) -> int:
    num_lines = 0
    for num_lines, line in enumerate(lines, start=1):  # noqa: B007 - the count is the answer
        print(line, flush=True)
    return num_lines


def _write_rows(frames: Iterable[FapFrame], file: IO[str], suffix: str, form: CurveForm) -> int:
    write = row_writer(file, suffix, form)
    num_rows = 0
    for num_rows, frame in enumerate(frames, start=1):  # noqa: B007 - the count is the answer
        write(to_seconds(frame.media_time), frame.sequence, _values(frame))
        file.flush()
    return num_rows


def _values(frame: FapFrame) -> NDArray[np.float32]:
    return np.frombuffer(frame.values, "<f4").astype(np.float32)


def _as_row(frame: FapFrame) -> str:
    values = _values(frame)
    shown = "  ".join(f"{values[n - 1]:6.0f}" for n in SHOWN_FAPS)
    return f"{to_seconds(frame.media_time):9.3f} s  {shown}"


def _write_fap(path: Path, session: str, frames: list[FapFrame]) -> int:
    steps_s = np.diff([to_seconds(frame.media_time) for frame in frames])
    frame_rate_hz = float(1.0 / np.median(steps_s[steps_s > 0])) if (steps_s > 0).any() else 50.0
    faps = np.array([_values(frame) for frame in frames], np.float32).reshape(-1, NUM_FAPS)
    write_fap(path, FapAnimation(name=session, frame_rate_hz=frame_rate_hz, faps=faps))
    return len(frames)
