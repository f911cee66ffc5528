"""The command ``kouxing``."""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import time
import webbrowser
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from evaluation.commands import app as evaluation_app
from shared.config import ControlConfig, GatewayConfig, load
from shared.errors import UserError
from training.commands import app as training_app

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Live Mandarin speech in, a talking 3-D face out.",
)
head_app = typer.Typer(no_args_is_help=True, help="The 3-D head.")
app.add_typer(head_app, name="head")
app.add_typer(training_app, name="train")
app.add_typer(evaluation_app, name="evaluate")
CONSOLE = Console(stderr=True)
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
JsonFile = Annotated[Path | None, typer.Option("--json", help="Also write the figures here.")]
Acoustic = Annotated[str, typer.Option(help="Model: combined, gmm, neural, or a file.")]
Control = Annotated[
    str, typer.Option(help="Where control takes commands; else $KOUXING_CONTROL, else this host.")
]


class PhoneFormat(StrEnum):
    """How phones are written."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    TEXTGRID = "textgrid"


def main() -> None:
    """Run the command line; a user's mistake is one line on standard error and status 2."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # as in `kouxing phones my.wav | head`
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
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
) -> None:
    """Run all services on this machine and watch over them."""
    from services.supervisor import Supervisor

    control_config = load("control", file=config)
    gateway_config = load("gateway", file=config)
    driver_config = load("driver", file=config)
    if not isinstance(control_config, ControlConfig) or not isinstance(
        gateway_config, GatewayConfig
    ):
        raise TypeError("the sections have types of their own")
    arguments = ["--config", str(config)] if config else []
    log_folder = Path(getattr(driver_config, "out", "out")) / "logs"
    supervisor = Supervisor(arguments, log_folder, CONSOLE)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it
    page = f"http://{gateway_config.host}:{gateway_config.port}"
    try:
        with CONSOLE.status("starting control, recognizer, synthesizer, driver and gateway"):
            supervisor.start()
            supervisor.wait_ready(control_config.commands)
        _say(f"the face is at {page}")
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
        while True:
            supervisor.check()
            time.sleep(0.2)
    except KeyboardInterrupt:
        CONSOLE.print("stopping")
    finally:
        supervisor.stop()


def _play_sample(path: Path, control: str) -> None:
    from services.speak import speak as stream
    from shared.audio_file import open_audio

    spoken = stream(open_audio(path), control, CONSOLE, session="demo", record=True)
    _say(f"spoke {path.name}: {spoken.num_phones} phones in {spoken.duration_s:.1f} s")
    if not spoken.video:
        raise UserError("no video was written; see the messages above")
    _say(f"wrote {spoken.video}")


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
        audio = open_audio(Path(source), block_s=0.1 if fast else 0.02)
    spoken = stream(
        audio, _control(control), CONSOLE, session=session, record=record, paced=not fast
    )
    _say(f"session {spoken.session}: {spoken.num_phones} phones in {spoken.duration_s:.1f} s")
    if spoken.video:
        _say(f"wrote {spoken.video}")


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
    _write_json(json_file, asdict(report))


# --- without services ----------------------------------------------------------------------------


@app.command()
def render(
    audio: Annotated[Path, typer.Argument(help="Audio file.")],
    video: Annotated[Path, typer.Argument(help="Video to write (.mp4).")],
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels.")] = "1280x720",
    rate: Annotated[float, typer.Option(help="Images per second.")] = 25.0,
) -> None:
    """Make a video of an audio file; no services need to be running."""
    from services import offline

    width_px, height_px = _size(size)
    samples = offline.mono_16k(audio)
    with Progress(console=CONSOLE, transient=True) as progress:
        hearing = progress.add_task("recognising", total=1.0)
        phones, frames = offline.live_frames(
            samples, on_progress=lambda share: progress.update(hearing, completed=share)
        )
        drawing = progress.add_task("drawing", total=1.0)
        num_images = offline.render_video(
            samples,
            frames,
            video,
            width_px=width_px,
            height_px=height_px,
            frame_rate_hz=rate,
            on_progress=lambda share: progress.update(drawing, completed=share),
        )
    if not phones:
        _say(f"{audio}: no speech was heard; the mouth stays closed")
    _say(f"wrote {video}: {num_images} images, {len({p.index for p in phones})} phones")


@app.command()
def phones(
    audio: Annotated[Path, typer.Argument(help="Audio file.")],
    acoustic: Acoustic = "combined",
    form: Annotated[PhoneFormat, typer.Option("--format", help="Form.")] = PhoneFormat.TABLE,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")] = None,
) -> None:
    """Recognise an audio file: units with their times."""
    from services import offline
    from services.recognizer.load import load_model, model_path
    from services.recognizer.pipeline import recognize
    from shared.messages import MEDIA_RATE_HZ
    from shared.phone_files import format_phones

    samples = offline.mono_16k(audio)
    found = recognize(load_model(model_path(acoustic)), samples, MEDIA_RATE_HZ)
    if not found:
        _say(f"{audio}: no speech was heard")
    _show(format_phones(found, form.value, len(samples) / MEDIA_RATE_HZ), output)


@app.command()
def align(
    audio: Annotated[Path, typer.Argument(help="Audio file.")],
    text: Annotated[str, typer.Argument(help="What is said: Chinese characters, or pinyin.")],
    acoustic: Acoustic = "combined",
    form: Annotated[PhoneFormat, typer.Option("--format", help="Form.")] = PhoneFormat.TABLE,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")] = None,
) -> None:
    """Find when each unit of a known text is said."""
    from services import offline
    from services.recognizer.load import load_model, model_path
    from shared.messages import MEDIA_RATE_HZ
    from shared.phone_files import format_phones
    from training.align import align_text

    samples = offline.mono_16k(audio)
    said = align_text(load_model(model_path(acoustic)), samples, MEDIA_RATE_HZ, text)
    _show(format_phones(said, form.value, len(samples) / MEDIA_RATE_HZ), output)


@app.command()
def bench(
    audio: Annotated[Path, typer.Argument(help="Audio file to stream.")],
    repeats: Annotated[int, typer.Option(min=1, help="How often to stream it.")] = 3,
    json_file: JsonFile = None,
) -> None:
    """Measure latency, CPU and images per second of the whole chain on this machine."""
    from evaluation.latency import measure, show

    latency = measure(audio, repeats, CONSOLE)
    show(latency, Console())
    _write_json(json_file, asdict(latency))


@head_app.command("export")
def head_export(
    glb: Annotated[Path, typer.Argument(help="File to write (.glb).")],
) -> None:
    """Write the head as a GLB with a morph target for every FAP."""
    from services.driver.glb import export_glb
    from services.driver.head import Head

    export_glb(Head.load(), glb)
    _say(f"wrote {glb} ({glb.stat().st_size / 1e6:.1f} MB)")


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


def _say(text: str) -> None:
    CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)


def _control(given: str) -> str:
    return load("client", overrides={"control": given} if given else {}).control


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UserError(f"--size {text}: write WIDTHxHEIGHT, for example 1280x720")
    width_px, height_px = int(width), int(height)
    if not (16 <= width_px <= 7680 and 16 <= height_px <= 4320):
        raise UserError(f"--size {text}: 16x16 to 7680x4320")
    if width_px % 2 or height_px % 2:
        raise UserError(f"--size {text}: both must be even for H.264")
    return width_px, height_px


def _write_json(path: Path | None, figures: object) -> None:
    if path is not None:
        _write_text(path, json.dumps(figures, indent=1, ensure_ascii=False, default=_plain))


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _show(text: str, output: Path | None) -> None:
    if output is None:
        sys.stdout.write(text)
    else:
        _write_text(output, text)


def _write_text(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
