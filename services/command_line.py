"""The command ``kouxing``."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import webbrowser
from dataclasses import asdict
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from evaluation.commands import app as evaluation_app
from evaluation.commands import plot_app
from services import offline_commands
from services.terminal import CONSOLE, JsonFile, say, write_json
from shared.config import ControlConfig, DriverConfig, GatewayConfig, load
from shared.errors import UserError
from training.commands import app as training_app

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Live Mandarin speech in, a talking 3-D face out.",
)
app.add_typer(offline_commands.head_app, name="head")
app.add_typer(training_app, name="train")
app.add_typer(evaluation_app, name="evaluate")
app.add_typer(plot_app, name="plot")
SERVICE_CLASSES = {
    "control": "ControlService",
    "recognizer": "RecognizerService",
    "synthesizer": "SynthesizerService",
    "driver": "DriverService",
    "gateway": "GatewayService",
}

SHOWN_FIGURES = {"in_audio_per_s", "out_fap_per_s", "frames_missed", "cpu_s"}

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="TOML file with a table a service.")
]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one key.")
]
Control = Annotated[
    str, typer.Option(help="Where control takes commands; else $KOUXING_CONTROL, else this host.")
]


def main() -> None:
    """Run the command line; a user's mistake is one line on standard error and status 2."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # as in `kouxing phones my.wav | head`
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # progress shows in a log file, too
    try:
        app()
    except UserError as error:
        CONSOLE.print(f"kouxing: {error}", style="red", markup=False, soft_wrap=True)
        sys.exit(2)


# --- services ------------------------------------------------------------------------------------


def _serve(section: str, file: Path | None, settings: list[str] | None) -> None:
    config = load(section, file=file, overrides=_overrides(settings))
    from shared.service import run_service

    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # peers come and go

    def make() -> Any:
        module = importlib.import_module(f"services.{section}.service")
        return getattr(module, SERVICE_CLASSES[section])(config)

    sys.exit(run_service(make, section, config.log_level))


@app.command()
def control(config: ConfigFile = None, settings: Settings = None) -> None:
    """Run control alone."""
    _serve("control", config, settings)


@app.command()
def recognizer(config: ConfigFile = None, settings: Settings = None) -> None:
    """Run a recognizer alone."""
    _serve("recognizer", config, settings)


@app.command()
def synthesizer(config: ConfigFile = None, settings: Settings = None) -> None:
    """Run a synthesizer alone."""
    _serve("synthesizer", config, settings)


@app.command()
def driver(config: ConfigFile = None, settings: Settings = None) -> None:
    """Run a driver alone."""
    _serve("driver", config, settings)


@app.command()
def gateway(config: ConfigFile = None, settings: Settings = None) -> None:
    """Run the gateway alone."""
    _serve("gateway", config, settings)


@app.command()
def run(
    config: ConfigFile = None,
    play: Annotated[
        Path | None, typer.Option(help="Speak this file first, recorded as out/demo.mp4.")
    ] = None,
    stop_after: Annotated[
        bool, typer.Option("--stop-after", help="Stop once the file has been played.")
    ] = False,
    head: Annotated[
        str, typer.Option(help="woman, man, elder, child, an .npz, or a .glb with morphs.")
    ] = "",
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
) -> None:
    """Run all services on this machine and watch over them."""
    from services.supervisor import Supervisor

    control_config = load("control", file=config)
    gateway_config = load("gateway", file=config)
    driver_config = load("driver", file=config)
    if not (
        isinstance(control_config, ControlConfig)
        and isinstance(gateway_config, GatewayConfig)
        and isinstance(driver_config, DriverConfig)
    ):
        raise TypeError("the sections have types of their own")
    arguments = ["--config", str(config)] if config else []
    out = Path(driver_config.out)
    environment = _chosen_head(head or driver_config.head, out)
    supervisor = Supervisor(arguments, out / "logs", CONSOLE, environment)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it
    page = f"http://{gateway_config.host}:{gateway_config.port}"
    try:
        with CONSOLE.status("starting control, recognizer, synthesizer, driver and gateway"):
            supervisor.start()
            supervisor.wait_ready(control_config.commands)
        supervisor.watch()
        say(f"the face is at {page}")
        has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        if browser and not stop_after and (has_display or sys.platform == "darwin"):
            webbrowser.open(page)
        if play is not None:
            _play_sample(play, control_config.commands)
        if stop_after:
            return
        CONSOLE.print(
            "listening: use the microphone on the page, or 'kouxing speak my.wav'; Ctrl-C ends"
        )
        supervisor.wait()
    except KeyboardInterrupt:
        CONSOLE.print("stopping")
    finally:
        supervisor.stop()


def _chosen_head(name: str, out: Path) -> dict[str, str]:
    """Return the environment in which window, videos and page show a head."""
    if name == DriverConfig().head:
        return {"KOUXING_DRIVER_HEAD": name}
    from services.driver.glb import export_glb
    from services.driver.scene import load_head

    for_page = (out / "head.glb").absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: cannot be made: {error.strerror}") from None
    export_glb(load_head(name), for_page)
    return {"KOUXING_DRIVER_HEAD": name, "KOUXING_GATEWAY_HEAD": str(for_page)}


def _play_sample(path: Path, control: str) -> None:
    from services.speak import speak as stream
    from shared.audio_file import open_audio

    spoken = stream(open_audio(path), control, CONSOLE, session="demo", record=True)
    say(f"spoke {path.name}: {spoken.num_phones} phones in {spoken.duration_s:.1f} s")
    if not spoken.video:
        raise UserError("no video was written; see the messages above")
    say(f"wrote {spoken.video}")


# --- clients -------------------------------------------------------------------------------------


@app.command()
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
    control: Control = "",
) -> None:
    """Stream a file, standard input or the microphone to a running system."""
    from services.speak import speak as stream
    from shared.audio_file import microphone, open_audio, raw_audio

    if source == "mic":
        audio = microphone()
    elif source == "-":
        audio = raw_audio(sys.stdin.buffer, rate, channels)
    else:
        audio = open_audio(Path(source))
    spoken = stream(
        audio, _control(control), CONSOLE, session=session, record=record, paced=not fast
    )
    say(f"session {spoken.session}: {spoken.num_phones} phones in {spoken.duration_s:.1f} s")
    if spoken.video:
        say(f"wrote {spoken.video}")


@app.command()
def listen(
    session: Annotated[str, typer.Argument(help="Name of the session; it may open later.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Record to a .fap or .jsonl file.")
    ] = None,
    control: Control = "",
) -> None:
    """Print or record the FAP stream of a session until it ends."""
    from services.listen import listen as follow

    follow(session, output, _control(control), CONSOLE)


@app.command()
def status(control: Control = "", json_file: JsonFile = None) -> None:
    """Show services, sessions, rates and latencies."""
    from shared.client import Client

    with Client(_control(control), deadline_s=3.0) as client:
        report = client.status()
    out = Console()
    table = Table("service", "instance", "state", "heard s ago", "clock ms", "figures")
    for service in report.services:
        figures = ", ".join(
            f"{name} {value:.4g}"
            for name, value in sorted(service.metrics.items())
            if name.endswith(("_p50", "_p95")) or name in SHOWN_FIGURES or _is_drop(name)
        )
        table.add_row(
            escape(service.service),
            escape(service.instance),
            service.state,
            f"{service.age_s:.1f}",
            f"{service.clock_offset_ms:.1f}",
            escape(figures),
        )
    out.print(table)
    sessions = Table("session", "state", "open s", "speaking", "recognizer", "synthesizer")
    for each in report.sessions:
        speaking = "yes" if each.speaking else "no"
        sessions.add_row(
            each.session,
            each.state,
            f"{each.age_s:.0f}",
            speaking,
            each.recognizer,
            each.synthesizer,
        )
    out.print(sessions)
    write_json(json_file, asdict(report))


offline_commands.add_to(app)


# --- inside --------------------------------------------------------------------------------------


def _overrides(settings: list[str] | None) -> dict[str, str]:
    overrides = {}
    for setting in settings or []:
        key, equals, value = setting.partition("=")
        if not equals:
            raise UserError(f"--set {setting}: write --set KEY=VALUE")
        overrides[key] = value
    return overrides


def _is_drop(name: str) -> bool:
    return name.startswith("dropped_") and not name.endswith("_per_s")


def _control(given: str) -> str:
    return load("client", overrides={"control": given} if given else {}).control
