"""``kouxing run``: all services on this machine, and a page that shows the face."""

from __future__ import annotations

import os
import signal
import sys
import webbrowser
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kouxing.services.cli.options import ConfigFile, HeadName
from kouxing.services.cli.running_system import announce, find_control
from kouxing.services.control.config import ControlConfig
from kouxing.services.driver.config import DriverConfig
from kouxing.services.kinds import KINDS, available_addresses, more_workers, read_settings
from kouxing.shared.config import COMMON, Settings, parse_assignments, variable
from kouxing.shared.endpoints import WILDCARDS, split_endpoint, with_host
from kouxing.shared.errors import UserError
from kouxing.shared.keys import control_endpoint
from kouxing.shared.terminal import CONSOLE, command_name, print_message

if TYPE_CHECKING:
    from kouxing.shared.audio_file import AudioSource


def run(
    config: ConfigFile = None,
    play: Annotated[
        Path | None, typer.Option(help="Speak this file first, recorded as out/demo.mp4.")
    ] = None,
    stop_after: Annotated[
        bool, typer.Option("--stop-after", help="Stop once the file has been played.")
    ] = False,
    head: HeadName = "",
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port of the page, instead of 8080.")
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            min=1,
            max=64,
            help="Recognizers and synthesizers; of two or more one that fails is replaced at once.",
        ),
    ] = 1,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="SERVICE.KEY=VALUE", help="Set one key of a service; repeatable."
        ),
    ] = None,
) -> None:
    """Run all services on this machine and restart those that crash."""
    from kouxing.services.cli.supervisor import Supervisor
    from kouxing.shared.audio_file import open_audio

    given = parse_assignments(assignments or [])
    if port is not None:
        given["gateway.port"] = str(port)
    settings = read_settings(config, given)
    for kind in KINDS.values():
        settings.load(kind.config_type)  # nothing starts where any key is wrong
    sample = None if play is None else open_audio(play)
    driver = settings.load(DriverConfig)
    arguments = ["--config", str(config)] if config else []
    out = Path(driver.out)
    addresses = available_addresses(settings)
    bound_control = addresses.get(
        variable("control", "control"), settings.load(ControlConfig).bound_control
    )
    control = _control_address(bound_control)
    environment = {
        **_assigned_environment(given),
        **head_environment(head or driver.head, out),
        **addresses,
        variable(COMMON, "control"): control,
        variable("control", "control"): bound_control,
    }
    insecure = settings.load(ControlConfig).insecure
    client_control = control_endpoint(control, insecure=insecure)
    more = more_workers(settings, workers)
    supervisor = Supervisor(arguments, out / "logs", CONSOLE, environment, more=more)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it
    for remark in _remarks_on_ports(settings, addresses, control):
        print_message(remark)
    try:
        with CONSOLE.status(f"starting {', '.join(KINDS)}"):
            supervisor.start()
            supervisor.wait_ready(client_control)
        supervisor.watch()
        page = supervisor.page_address(client_control)
        with announce(client_control):
            print_message(f"the face is at {page}")
            has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
            if browser and not stop_after and (has_display or sys.platform == "darwin"):
                webbrowser.open(page)
            if sample is not None:
                _play_sample(sample, client_control)
            if stop_after:
                return
            print_message(
                "ready: use the microphone on the page, or, in another terminal,"
                f" {command_name()} speak my.wav; Ctrl-C ends"
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
    from kouxing.services.driver.head.glb_export import export_glb
    from kouxing.services.driver.render.scene import load_head

    page_head = (out / "head.glb").absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: cannot be made: {error.strerror}") from None
    export_glb(load_head(name), page_head)
    return environment | {"KOUXING_GATEWAY_HEAD": str(page_head)}


def _assigned_environment(assignments: Mapping[str, str]) -> dict[str, str]:
    """Return the environment that gives services what ``--set`` says, whatever else does."""
    environment = {}
    for name, value in assignments.items():
        table, _, key = name.partition(".")
        for each in (COMMON, *KINDS) if table == COMMON else (table,):
            environment[variable(each, key)] = value
    return environment


def _control_address(bound: str) -> str:
    """Return where services and clients of this machine find control."""
    host, _ = split_endpoint(bound, "control.control")
    return with_host(bound, "127.0.0.1") if host in WILDCARDS else bound


def _remarks_on_ports(settings: Settings, moved: Mapping[str, str], control: str) -> Iterator[str]:
    """Yield what a user is told of default ports that are taken."""
    taken = [
        str(each.value)
        for kind in KINDS.values()
        for each in settings.describe(kind.config_type)
        if each.is_default and variable(kind.name, each.key) in moved
    ]
    if taken:
        yield f"taken by other programs: {', '.join(taken)}; free ports are used instead"
    if variable("control", "control") in moved:
        if running := find_control():
            where, _, _ = running.partition(" ")
            yield f"kouxing runs already, with control at {where}; this is one more"
        yield f"your kouxing commands find this one; other programs: KOUXING_CONTROL={control}"


def _play_sample(sample: AudioSource, control: str) -> None:
    from kouxing.services.cli.streaming import stream

    summary = stream(sample, control, CONSOLE, session="demo", record=True)
    print_message(f"spoke {sample.name}: {summary.num_phones} phones in {summary.duration_s:.1f} s")
    if not summary.video:
        raise UserError("no video was written; see the messages above")
    print_message(f"wrote {summary.video}")
