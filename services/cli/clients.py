"""The commands that talk to a running system."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from services.cli.terminal import CONSOLE, JsonFile, VoiceFile, print_message, write_json
from services.kinds import read_settings
from shared.config import ServiceConfig

SHOWN_FIGURES = {"in_audio_chunk_per_s", "out_fap_frame_per_s", "frames_missed", "cpu_s"}

Control = Annotated[
    str, typer.Option(help="Where control takes commands; else $KOUXING_CONTROL, else this host.")
]


def speak(
    source: Annotated[
        str, typer.Argument(metavar="FILE|-|mic", help="'-': raw int16 from standard input.")
    ],
    session: Annotated[str, typer.Option(help="Name of the session.")] = "",
    record: Annotated[
        bool, typer.Option("--record", help="The driver writes <session>.mp4.")
    ] = False,
    fast: Annotated[
        bool, typer.Option("--fast", help="As fast as possible, not in real time.")
    ] = False,
    rate: Annotated[int, typer.Option(help="Sample rate of '-', Hz.")] = 16000,
    channels: Annotated[int, typer.Option(help="Channels of '-'.")] = 1,
    voice: VoiceFile = None,
    control: Control = "",
) -> None:
    """Stream a file, standard input or the microphone to a running system."""
    from services.cli.streaming import stream
    from services.recognizer.voice import read_profile
    from shared.audio_file import microphone, open_audio, raw_audio

    profile = b"" if voice is None else read_profile(voice)
    if source == "mic":
        audio = microphone()
    elif source == "-":
        audio = raw_audio(sys.stdin.buffer, rate, channels)
    else:
        audio = open_audio(Path(source))
    summary = stream(
        audio,
        _control_address(control),
        CONSOLE,
        session=session,
        record=record,
        paced=not fast,
        voice=profile,
    )
    print_message(
        f"session {summary.session}: {summary.num_phones} phones in {summary.duration_s:.1f} s"
    )
    if summary.video:
        print_message(f"wrote {summary.video}")


def listen(
    session: Annotated[str, typer.Argument(help="Name of the session; it may open later.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Record to a .fap or .jsonl file.")
    ] = None,
    control: Control = "",
) -> None:
    """Print or record the FAP stream of a session until it ends."""
    from services.cli.follow import follow

    follow(session, output, _control_address(control), CONSOLE)


def status(control: Control = "", json_file: JsonFile = None) -> None:
    """Show services, sessions, rates and latencies."""
    from shared.client import Client

    with Client(_control_address(control), deadline_s=3.0) as client:
        report = client.status()
    out = Console()
    table = Table("service", "instance", "role", "state", "heartbeat s ago", "clock ms", "figures")
    for service in report.services:
        figures = ", ".join(
            f"{name} {value:.4g}"
            for name, value in sorted(service.metrics.items())
            if name.endswith(("_p50", "_p95")) or name in SHOWN_FIGURES or _is_drop(name)
        )
        table.add_row(
            escape(service.service),
            escape(service.instance),
            service.role,
            service.state,
            f"{service.age_s:.1f}",
            f"{service.clock_offset_ms:.1f}",
            escape(figures),
        )
    out.print(table)
    sessions = Table("session", "state", "open s", "speaking", "workers")
    for each in report.sessions:
        speaking = "yes" if each.speaking else "no"
        sessions.add_row(
            each.session,
            each.state,
            f"{each.age_s:.0f}",
            speaking,
            escape(", ".join(sorted({*each.workers.values()}))),
        )
    out.print(sessions)
    write_json(json_file, asdict(report))


def _is_drop(name: str) -> bool:
    return name.startswith("dropped_") and not name.endswith("_per_s")


def _control_address(given: str) -> str:
    return read_settings().load(ServiceConfig, {"control": given} if given else {}).control
