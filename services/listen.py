"""Prints or records the FAP stream of a session."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from shared.bus import Socket
from shared.client import Client
from shared.clock import to_seconds
from shared.errors import UserError
from shared.fap_file import FapAnimation, write_fap
from shared.faps import FAPS, NUM_FAPS
from shared.messages import EndOfFaps, FapFrame, StatusReport

OPEN_POLL_S = 0.2
SHOWN_FAPS = (3, 4, 5, 6, 16, 17)  # of a printed frame: jaw, lips, corner, protrusion


def listen(session: str, output: Path | None, control: str, console: Console) -> None:
    """Follow a session from now on to its end.

    Raises
    ------
    UserError
        If control does not answer or the file cannot be written.
    """
    if output is not None and output.suffix not in (".fap", ".jsonl"):
        raise UserError(f"{output}: write to a .fap or .jsonl file")
    with Client(control) as client:
        with console.status(f"waiting for session {session}"):
            faps = _publisher_of(session, client)
        socket = client.bus.connect_subscriber(faps)
        for kind in (FapFrame, EndOfFaps):
            socket.subscribe(kind, session)
        frames = _frames(socket, client, session)
        try:
            if output is None:
                num_frames = _print(frames, sys.stdout, _as_row)
            elif output.suffix == ".jsonl":
                with output.open("w", encoding="utf-8") as file:
                    num_frames = _print(frames, file, _as_json)
            else:
                num_frames = _write_fap(output, session, list(frames))
        except OSError as error:
            raise UserError(f"{output}: cannot be written: {error.strerror}") from None
    console.print(f"session {session} ended: {num_frames} FAP frames", highlight=False)


def _publisher_of(session: str, client: Client) -> str:
    """Return where a session's FAP frames are published, waiting until it opens."""
    while True:
        report = client.status()
        instance = {s.session: s.synthesizer for s in report.sessions}.get(session)
        for service in report.services:
            if service.instance == instance and "faps" in service.endpoints:
                return service.endpoints["faps"]
        time.sleep(OPEN_POLL_S)


def _frames(socket: Socket, client: Client, session: str) -> Iterator[FapFrame]:
    """Yield frames until the session ends or the user interrupts."""
    try:
        while True:
            if not socket.wait(2.0) and not _is_open(session, client.status()):
                return
            for received in socket.receive():
                if isinstance(received.message, EndOfFaps):
                    return
                if isinstance(received.message, FapFrame):
                    yield received.message
    except KeyboardInterrupt:
        return


def _is_open(session: str, report: StatusReport) -> bool:
    return any(each.session == session for each in report.sessions)


def _print(frames: Iterator[FapFrame], out: IO[str], form: Callable[[FapFrame], str]) -> int:
    num_frames = 0
    for num_frames, frame in enumerate(frames, start=1):  # noqa: B007 - the count is the answer
        out.write(form(frame) + "\n")
        out.flush()
    return num_frames


def _values(frame: FapFrame) -> NDArray[np.float32]:
    return np.frombuffer(frame.values, "<f4").astype(np.float32)


def _as_json(frame: FapFrame) -> str:
    faps = [round(float(value), 2) for value in _values(frame)]
    time_s = to_seconds(frame.media_time)
    return json.dumps({"time_s": time_s, "sequence": frame.sequence, "faps": faps})


def _as_row(frame: FapFrame) -> str:
    values = _values(frame)
    shown = "  ".join(f"{FAPS[n - 1].name} {values[n - 1]:5.0f}" for n in SHOWN_FAPS)
    return f"{to_seconds(frame.media_time):9.3f} s  {shown}"


def _write_fap(path: Path, session: str, frames: list[FapFrame]) -> int:
    steps_s = np.diff([to_seconds(frame.media_time) for frame in frames])
    frame_rate_hz = float(1.0 / np.median(steps_s[steps_s > 0])) if (steps_s > 0).any() else 50.0
    faps = np.array([_values(frame) for frame in frames], np.float32).reshape(-1, NUM_FAPS)
    write_fap(path, FapAnimation(name=session, frame_rate_hz=frame_rate_hz, faps=faps))
    return len(frames)
