"""Prints or records the FAP stream of a session."""

from __future__ import annotations

import json
import sys
import time
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
        try:
            if output is None:
                frames = _follow(socket, client, session, sys.stdout, as_json=False)
            elif output.suffix == ".jsonl":
                with output.open("w", encoding="utf-8") as file:
                    frames = _follow(socket, client, session, file, as_json=True)
            else:
                frames = _follow(socket, client, session, None, as_json=False)
                _write_fap(output, session, frames)
        except OSError as error:
            raise UserError(f"{output}: cannot be written: {error.strerror}") from None
    console.print(f"session {session} ended: {len(frames)} FAP frames")


def _publisher_of(session: str, client: Client) -> str:
    """Return where a session's FAP frames are published, waiting until it opens."""
    while True:
        report = client.status()
        instance = {s.session: s.synthesizer for s in report.sessions}.get(session)
        for service in report.services:
            if service.instance == instance and "faps" in service.endpoints:
                return service.endpoints["faps"]
        time.sleep(OPEN_POLL_S)


def _follow(
    socket: Socket, client: Client, session: str, out: IO[str] | None, *, as_json: bool
) -> list[tuple[float, NDArray[np.float32]]]:
    frames: list[tuple[float, NDArray[np.float32]]] = []
    try:
        while True:
            if not socket.wait(2.0) and not _is_open(session, client.status()):
                return frames
            for received in socket.receive():
                message = received.message
                if isinstance(message, EndOfFaps):
                    return frames
                if isinstance(message, FapFrame):
                    values = np.frombuffer(message.values, "<f4").astype(np.float32)
                    frames.append((to_seconds(message.media_time), values))
                    if out is not None:
                        out.write(_line(message, values, as_json=as_json))
                        out.flush()
    except KeyboardInterrupt:
        return frames


def _is_open(session: str, report: StatusReport) -> bool:
    return any(each.session == session for each in report.sessions)


def _line(frame: FapFrame, values: NDArray[np.float32], *, as_json: bool) -> str:
    time_s = to_seconds(frame.media_time)
    if as_json:
        entry = {
            "time_s": time_s,
            "sequence": frame.sequence,
            "faps": [round(float(v), 2) for v in values],
        }
        return json.dumps(entry) + "\n"
    shown = "  ".join(f"{FAPS[n - 1].name} {values[n - 1]:5.0f}" for n in SHOWN_FAPS)
    return f"{time_s:9.3f} s  {shown}\n"


def _write_fap(path: Path, session: str, frames: list[tuple[float, NDArray[np.float32]]]) -> None:
    times_s = np.array([time_s for time_s, _ in frames])
    steps_s = np.diff(times_s)
    frame_rate_hz = float(1.0 / np.median(steps_s[steps_s > 0])) if (steps_s > 0).any() else 50.0
    values = np.array([faps for _, faps in frames], np.float32).reshape(-1, NUM_FAPS)
    write_fap(path, FapAnimation(name=session, frame_rate_hz=frame_rate_hz, faps=values))
