"""``kouxing run``: all services on this machine, and a page that shows the face."""

from __future__ import annotations

import os
import signal
import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from services.cli.services import ConfigFile
from services.cli.terminal import CONSOLE, print_message
from services.control.config import ControlConfig
from services.driver.config import DriverConfig
from services.gateway.config import GatewayConfig
from services.kinds import KINDS, read_settings
from shared.errors import UserError


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
    """Run all services on this machine and restart those that crash."""
    from services.cli.supervisor import Supervisor

    settings = read_settings(config)
    control, gateway = settings.load(ControlConfig), settings.load(GatewayConfig)
    driver = settings.load(DriverConfig)
    for kind in KINDS.values():
        settings.load(kind.config_type)  # nothing starts where any key is wrong
    arguments = ["--config", str(config)] if config else []
    out = Path(driver.out)
    environment = head_environment(head or driver.head, out)
    supervisor = Supervisor(arguments, out / "logs", CONSOLE, environment)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it
    page = f"http://{gateway.host}:{gateway.port}"
    try:
        with CONSOLE.status(f"starting {', '.join(KINDS)}"):
            supervisor.start()
            supervisor.wait_ready(control.commands)
        supervisor.watch()
        print_message(f"the face is at {page}")
        has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        if browser and not stop_after and (has_display or sys.platform == "darwin"):
            webbrowser.open(page)
        if play is not None:
            _play_sample(play, control.commands)
        if stop_after:
            return
        print_message(
            "ready: use the microphone on the page, or 'kouxing speak my.wav'; Ctrl-C ends"
        )
        supervisor.wait()
    except KeyboardInterrupt:
        print_message("stopping")
    finally:
        supervisor.stop()


def head_environment(name: str, out: Path) -> dict[str, str]:
    """Return the environment in which window, videos and page show a head.

    Parameters
    ----------
    name
        A head of the package, or a file.
    out
        Folder for the GLB that is made for the page.

    Raises
    ------
    UserError
        If there is no such head, or the GLB cannot be written.
    """
    environment = {"KOUXING_DRIVER_HEAD": name}
    if name == DriverConfig().head:
        return environment
    from services.driver.head.glb_export import export_glb
    from services.driver.render.scene import load_head

    page_head = (out / "head.glb").absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: cannot be made: {error.strerror}") from None
    export_glb(load_head(name), page_head)
    return environment | {"KOUXING_GATEWAY_HEAD": str(page_head)}


def _play_sample(path: Path, control: str) -> None:
    from services.cli.streaming import stream
    from shared.audio_file import open_audio

    summary = stream(open_audio(path), control, CONSOLE, session="demo", record=True)
    print_message(f"spoke {path.name}: {summary.num_phones} phones in {summary.duration_s:.1f} s")
    if not summary.video:
        raise UserError("no video was written; see the messages above")
    print_message(f"wrote {summary.video}")
