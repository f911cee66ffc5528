"""Prints or records the FAP stream of a session."""

from __future__ import annotations

import json
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from shared.client import Client
from shared.clock import to_seconds
from shared.errors import UserError
from shared.face.fap_file import FapAnimation, write_fap
from shared.face.faps import FAPS, NUM_FAPS
from shared.follower import PollingLoop, SessionFollower
from shared.wire.face import EndOfFaps, FapFrame

OPEN_POLL_S = 0.2
SILENT_S = 2.0  # without frames, control is asked where the session is
SHOWN_FAPS = (3, 4, 5, 6, 16, 17)  # of a printed frame: jaw, lips, corner, protrusion


def follow(session: str, output: Path | None, control: str, console: Console) -> None:
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
            while (endpoints := _endpoints(session, client)) is None:
                time.sleep(OPEN_POLL_S)
        frames = _frames(session, endpoints, client, console)
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


def _endpoints(session: str, client: Client) -> dict[str, str] | None:
    """Return where a session is published; None if it is not open."""
    for state in client.status().sessions:
        if state.session == session and "faps" in state.endpoints:
            return state.endpoints
    return None


def _frames(
    session: str, endpoints: dict[str, str], client: Client, console: Console
) -> Iterator[FapFrame]:
    """Yield frames, wherever the session moves, until it ends or the user interrupts."""
    frames: deque[FapFrame] = deque()
    loop = PollingLoop(client.bus)
    follower = SessionFollower(
        loop,
        session,
        {FapFrame: frames.append, EndOfFaps: lambda _end: None},
        on_complete=lambda: console.print(f"following session {session}", highlight=False),
    )
    follower.start(0, endpoints)
    try:
        while not follower.has_ended:
            if not loop.step(SILENT_S):
                found = _endpoints(session, client)
                if found is None:
                    return
                if found != endpoints:
                    endpoints = found
                    follower.start(0, endpoints)
            while frames:
                yield frames.popleft()
    except KeyboardInterrupt:
        return


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
