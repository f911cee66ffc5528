"""The commands that talk to a running system."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kouxing.services.cli.options import (
    SPEECH_FORMATS,
    AudioTrack,
    Language,
    ListenFormat,
    MouthFile,
    PhoneAlphabet,
    reject_options,
)
from kouxing.services.cli.system.running_system import open_control_address
from kouxing.services.service_kinds import read_settings
from kouxing.shared.command.terminal import (
    Force,
    JsonFile,
    check_output,
    plural,
    print_message,
    print_table,
    write_json,
)
from kouxing.shared.errors import UserError
from kouxing.shared.face.expressions import DEFAULT_HOLD_S, ExpressionName, check_expressions
from kouxing.shared.name_rules import NAME_RULE, is_name

if TYPE_CHECKING:
    from kouxing_client import Lateness

SHOWN_METRICS = {
    *("in_audio_chunk_per_s", "out_fap_frame_per_s", "frames_missed", "cpu_s"),
    *("load", "network_hop", "light_sessions"),
}

Control = Annotated[
    str,
    typer.Option(
        metavar="ADDRESS",
        help="Address of control, tcp://HOST:PORT. Default: $KOUXING_CONTROL, or your system on"
        " this machine.",
    ),
]


def speak(
    source: Annotated[
        str,
        typer.Argument(
            metavar="FILE|-|mic|monitor",
            help="Audio or video file, '-' for standard input in any format, 'mic' for a"
            " microphone, or 'monitor' for the audio that this machine plays.",
        ),
    ],
    session: Annotated[str, typer.Option(help="Name of the session. Default: generated.")] = "",
    record: Annotated[
        bool, typer.Option("--record", help="Record the face: the driver writes <session>.mp4.")
    ] = False,
    fast: Annotated[
        bool, typer.Option("--fast", help="Send as fast as possible instead of in real time.")
    ] = False,
    device: Annotated[
        str,
        typer.Option(
            help="Part of the name of a device or program for mic or monitor, as in 'kouxing"
            " devices'. Default: the system's default device."
        ),
    ] = "",
    raw: Annotated[
        bool, typer.Option("--raw", help="Read raw samples: 16-bit integers, little-endian.")
    ] = False,
    rate: Annotated[
        int | None, typer.Option(help="Sample rate of raw samples, Hz. Default: 16000.")
    ] = None,
    channels: Annotated[
        int | None,
        typer.Option(min=1, max=8, help="Number of channels of raw samples. Default: 1."),
    ] = None,
    track: AudioTrack = None,
    mouth: MouthFile = None,
    language: Language = None,
    control: Control = "",
) -> None:
    """Stream a file, a pipe, the microphone or this machine's audio to a running system.

    The exit status is 1 if --record was given and no video was written.
    """
    from kouxing.services.cli.system.streaming import stream
    from kouxing.services.recognizer.lips.mouth_profile import read_mouth_profile
    from kouxing.shared.audio.audio_file import open_audio
    from kouxing.shared.audio.raw_format import RawFormat
    from kouxing.shared.audio.sound_devices import open_microphone, open_monitor

    profile = b"" if mouth is None else read_mouth_profile(mouth)
    if source in ("mic", "monitor"):
        reject_options(
            f"does not apply to {source}; leave it out",
            fast=fast, raw=raw, rate=rate, channels=channels, track=track,
        )  # fmt: skip
    else:
        reject_options("applies to mic and monitor: kouxing speak mic --device NAME", device=device)
    if raw:
        reject_options("does not apply to raw samples; leave it out", track=track)
    else:
        reject_options("applies to raw samples; add --raw", rate=rate, channels=channels)
    if source == "mic":
        audio = open_microphone(device)
    elif source == "monitor":
        audio = open_monitor(device)
    else:
        raw_format = RawFormat(16_000 if rate is None else rate, channels or 1)
        audio = open_audio(Path(source), track=track, raw=raw_format if raw else None)
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # closes the session
    with open_control_address(control) as endpoint:
        summary = stream(
            audio,
            endpoint,
            session=_session_name(session),
            record=record,
            paced=not fast,
            mouth_profile=profile,
            language=language,
        )
    print_message(
        f"session {summary.session}: {plural(summary.num_phones, 'phone')} in"
        f" {summary.duration_s:.1f} s"
    )
    if summary.video:
        print_message(f"wrote {summary.video}")
    elif record:
        raise typer.Exit(1)


def devices() -> None:
    """List the devices for 'kouxing speak mic' and 'kouxing speak monitor'."""
    from kouxing.shared.audio.sound_devices import list_sound_devices

    problems: list[str] = []
    devices = list_sound_devices(problems.append)
    for problem in problems:
        print_message(problem)
    if not devices and not problems:
        print_message("no microphone and no output were found; connect a microphone")
    for device in devices:
        source = "mic" if device.kind == "mic" else "monitor"
        typer.echo(f"{device.kind}: {device.name}")
        typer.echo(f'    kouxing speak {source} --device "{device.name}"')


def listen(
    session: Annotated[
        str, typer.Argument(help="Name of the session. It may open later. Default: the newest.")
    ] = "",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="File for the frames (.fap, .csv, .jsonl or .glb), or for drawn mouths (.tsv, .xml"
            " or .json of Rhubarb Lip Sync).",
        ),
    ] = None,
    as_format: Annotated[
        ListenFormat | None,
        typer.Option(
            "--as",
            metavar="VALUES",
            help=f"Values to print or record: {', '.join(ListenFormat)}. Default: faps, or the"
            " first that the file's format supports.",
        ),
    ] = None,
    alphabet: PhoneAlphabet = None,
    force: Force = False,
    control: Control = "",
) -> None:
    """Print or record the output of a session until it ends.

    Blendshapes are printed as JSON lines. With --as rhubarb, a line is printed whenever the mouth
    shape changes. Syllables and phones are printed once they are final.
    """
    from kouxing.services.cli.system.follow import follow

    if as_format is not ListenFormat.PHONES:
        reject_options("applies to phones; add --as phones", alphabet=alphabet)
    if as_format in SPEECH_FORMATS:
        reject_options(f"does not apply to {as_format}, which are only printed", output=output)
    if as_format is ListenFormat.LIVELINK and output is None:
        raise UserError("--as livelink writes a CSV file; add --output face.csv")
    check_output(output, force=force)
    follow(_session_name(session), output, as_format, open_control_address(control), alphabet)


def send(
    targets: Annotated[
        list[str],
        typer.Argument(
            metavar="URL", help="Addresses of programs that show the face, such as vmc://HOST:PORT."
        ),
    ],
    session: Annotated[
        str, typer.Option(help="Name of the session. Default: always the newest.")
    ] = "",
    control: Control = "",
) -> None:
    """Animate avatars in other programs, over VMC, Live Link Face, OSC or VTube Studio."""
    from kouxing.services.cli.system.send import send_to
    from kouxing.services.senders.protocols import parse_target
    from kouxing.services.synthesizer.config import SynthesizerConfig

    config = read_settings().load(SynthesizerConfig)
    parsed = [parse_target(url) for url in targets]
    with open_control_address(control) as endpoint:
        send_to(parsed, _session_name(session), endpoint, idle_motion=config.idle_motion)


def express(
    arguments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SESSION] NAME=STRENGTH",
            help="Session (default: all faces), then expressions with strengths from 0 to 1, such"
            f" as joy=0.4: {', '.join(ExpressionName)}.",
        ),
    ] = None,
    hold: Annotated[
        float | None,
        typer.Option(help=f"Seconds until the expressions fade. Default: {DEFAULT_HOLD_S:g}."),
    ] = None,
    control: Control = "",
) -> None:
    """Show expressions on a face; without expressions, clear the current ones."""
    from kouxing_client import Refused

    from kouxing.shared.command.client_connection import connect_client

    words = list(arguments or ())
    session = words.pop(0) if words and "=" not in words[0] else ""
    if session and not is_name(session):
        raise UserError(
            f"{session!r} is not a session name ({NAME_RULE}); write an expression as"
            " NAME=STRENGTH, for example joy=0.4"
        )
    strengths = dict(map(_parse_strength, words))
    if hold is not None and not strengths:
        raise UserError("--hold needs an expression: kouxing express joy=0.4 --hold 2")
    hold_s = DEFAULT_HOLD_S if hold is None else hold
    check_expressions(strengths, hold_s)
    with open_control_address(control) as endpoint, connect_client(endpoint) as client:
        all_sessions = [state.session for state in client.status().sessions]
        if session and session not in all_sessions:
            raise UserError(
                f"session {session!r} does not exist (open sessions:"
                f" {', '.join(all_sessions) or 'none'}); to change all faces, leave it out"
                + (f", and write {session}=0.4" if session in set(ExpressionName) else "")
            )
        for name in [session] if session else ["", *all_sessions]:
            try:
                client.set_face(name, expressions=strengths, hold_s=hold_s)
            except Refused as refusal:
                if session or refusal.code != "unknown-session":
                    raise
                all_sessions.remove(name)  # it has just closed
    faces = [session] if session else [*all_sessions, "the face at rest"]
    shown = ", ".join(f"{name} {strength:g}" for name, strength in strengths.items())
    action = f"showing {shown} for {hold_s:g} s" if shown else "cleared the expressions"
    print_message(f"{action}: {', '.join(faces)}")


def _parse_strength(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise UserError(f"{text!r}: write NAME=STRENGTH, for example joy=0.4") from None


def status(control: Control = "", json_file: JsonFile = None, force: Force = False) -> None:
    """Show services, sessions, rates and latencies."""
    import msgspec

    from kouxing.shared.command.client_connection import connect_client

    check_output(json_file, force=force)
    with (
        open_control_address(control) as endpoint,
        connect_client(endpoint, timeout_s=3.0) as client,
    ):
        report = client.status()
    services = []
    for service in report.services:
        metrics = ", ".join(
            f"{name} {value:.4g}"
            for name, value in sorted(service.metrics.items())
            if name.endswith(("_p50", "_p95"))
            or name in SHOWN_METRICS
            or (name.startswith("dropped_") and not name.endswith("_per_s"))
        )
        services.append((service.instance, service.state, f"{service.age_s:.1f} s ago", metrics))
    print_table(("service", "state", "last seen", "metrics"), services)
    if not report.sessions:
        typer.echo("no session is open")
    else:
        sessions = [
            (
                session.session,
                "speaking" if session.speaking else session.state,
                f"{session.age_s:.0f} s",
                _lateness_text(session.lateness),
                f"{session.skipped_s:.1f} s",
                ", ".join(sorted({*session.workers.values()})),
            )
            for session in report.sessions
        ]
        lateness = "late: p50, p95, worst"
        columns = ("session", "state", "open for", lateness, "skipped", "workers")
        print_table(columns, sessions)
    write_json(json_file, msgspec.to_builtins(report))


def doctor(control: Control = "") -> None:
    """Check keys, addresses, clocks and versions from this machine, and print remedies."""
    from kouxing.services.cli.system.doctor import run_checks

    num_checks = num_failed = 0
    for check in run_checks(control):
        num_checks += 1
        num_failed += bool(check.remedy)
        typer.echo(f"{'FAIL' if check.remedy else 'ok  '} {check.subject}: {check.result}")
        for line in check.remedy.splitlines():
            typer.echo(f"     {line}")
    typer.echo(f"{num_failed} of {plural(num_checks, 'check')} failed")
    if num_failed:
        raise typer.Exit(1)


def _session_name(name: str) -> str:
    """Return a session name after checking it. An empty name is allowed."""
    if name and not is_name(name):
        raise UserError(f"{name!r} is not a session name; {NAME_RULE}")
    return name


def _lateness_text(late: Lateness | None) -> str:
    return "" if late is None else f"{late.p50_ms:.0f}, {late.p95_ms:.0f}, {late.worst_ms:.0f} ms"
