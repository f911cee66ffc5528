"""``kouxing run``: all services on this machine, and a page that shows the face."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kouxing.services.cli.heads import ensure_page_heads
from kouxing.services.cli.options import (
    Assignments,
    AudioTrack,
    ConfigFile,
    HeadName,
    reject_options,
)
from kouxing.services.cli.system.running_system import (
    announce_system,
    lock_output_folder,
    lock_startup,
    running_systems,
)
from kouxing.services.control.config import ControlConfig
from kouxing.services.driver.config import DriverConfig
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.heads import DEFAULT_HEAD, HEAD_NAMES
from kouxing.services.service_kinds import (
    CONFIG_TYPES,
    KINDS,
    available_port_environment,
    extra_worker_environments,
    read_settings,
)
from kouxing.shared.command.terminal import CONSOLE, command_name, plural, print_message
from kouxing.shared.errors import UserError
from kouxing.shared.interrupt import clear_interrupt, install_interrupt_handler
from kouxing.shared.settings.config import (
    COMMON,
    Settings,
    key_types,
    parse_assignments,
    variable_name,
)
from kouxing.shared.settings.endpoints import WILDCARDS, split_endpoint, with_host
from kouxing.shared.settings.keys import check_keys, control_endpoint

if TYPE_CHECKING:
    from kouxing.shared.audio.audio_file import AudioSource

CONTROL_VARIABLE = variable_name(COMMON, "control")
BOUND_CONTROL_VARIABLE = variable_name("control", "control")
_SAMPLE_SESSION = "demo"


def run(
    config: ConfigFile = None,
    play: Annotated[
        Path | None, typer.Option(help="Play this file first, and record it as out/demo.mp4.")
    ] = None,
    track: AudioTrack = None,
    stop_after: Annotated[
        bool, typer.Option("--stop-after", help="Stop after playing the file.")
    ] = False,
    head: HeadName = "",
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port of the page. Default: 8080.")
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            min=1,
            max=64,
            help="Number of recognizers, and of synthesizers. With two or more, another worker"
            " takes over immediately if one fails.",
        ),
    ] = 1,
    assignments: Assignments = None,
) -> None:
    """Run all services on this machine, and restart any that crash or hang."""
    from kouxing.services.cli.launch.supervisor import Supervisor

    if play is None:
        reject_options("needs --play FILE", stop_after=stop_after, track=track)
    chosen_port = {} if port is None else {"gateway.port": str(port)}
    given = parse_assignments(assignments or []) | chosen_port
    settings = read_settings(config, given)
    for kind in KINDS.values():
        settings.load(kind.config_type)  # if a key is wrong, nothing starts
    out = Path(settings.load(DriverConfig).out)
    with lock_output_folder(out), contextlib.ExitStack() as startup:
        video = out / f"{_SAMPLE_SESSION}.mp4"
        sample = None if play is None else _open_sample(play, track, video)
        startup.enter_context(
            lock_startup(lambda: print_message("waiting until another kouxing has started"))
        )
        free_ports = _free_port_environment(settings, has_port_option=port is not None)
        control_environment = _control_environment(settings, free_ports)
        control_address = control_environment[CONTROL_VARIABLE]
        control = _check_keys(settings, control_address)
        supervisor = Supervisor(
            ["--config", str(config)] if config else [],
            out / "logs",
            CONSOLE,
            {
                **assigned_environment(given),
                **head_environment(settings, head, out),
                **token_environment(settings),
                **free_ports,
                **control_environment,
            },
            extra_workers=extra_worker_environments(settings, workers),
        )
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
        install_interrupt_handler()  # a shell's background processes ignore SIGINT
        if warning := _port_warning(settings, free_ports, control_address):
            print_message(warning)
        try:
            status = CONSOLE.status(f"starting {', '.join(KINDS)}")
            with status if CONSOLE.is_terminal else contextlib.nullcontext():  # not in a full log
                ensure_page_heads()
                supervisor.start()
                supervisor.wait_ready(control)
            startup.close()
            supervisor.watch()
            page = supervisor.page_address(control)
            with announce_system(control):
                print_message(f"the face is at {page}")
                if browser and not stop_after:
                    _open_browser(page)
                if sample is not None:
                    _play_sample(sample, control)
                if not stop_after:
                    print_message(
                        "ready: use the microphone on the page, or run in another terminal:"
                        f" {command_name()} speak my.wav; press Ctrl-C to stop"
                    )
                    supervisor.wait()
        except KeyboardInterrupt:
            clear_interrupt()
            print_message("stopping")
        finally:
            supervisor.stop()


def _free_port_environment(settings: Settings, *, has_port_option: bool) -> dict[str, str]:
    """Return the environment in which free ports replace the default ports that are in use.

    An error names the option that set the port.
    """
    try:
        return available_port_environment(settings)
    except UserError as error:
        key = "--port:" if has_port_option else "gateway.port:"
        raise UserError(str(error).replace("gateway.port:", key)) from None


def _control_environment(settings: Settings, free_ports: Mapping[str, str]) -> dict[str, str]:
    """Return the address that control binds, and the one that others on this machine use."""
    bound = free_ports.get(BOUND_CONTROL_VARIABLE, settings.load(ControlConfig).bound_control)
    host, _ = split_endpoint(bound, "control.control")
    control = with_host(bound, "127.0.0.1") if host in WILDCARDS else bound
    return {BOUND_CONTROL_VARIABLE: bound, CONTROL_VARIABLE: control}


def _check_keys(settings: Settings, control: str) -> str:
    """Check all keys; return the endpoint of control for clients, with its public key."""
    insecure = settings.load(ControlConfig).insecure
    if not insecure:
        check_keys({kind.name: kind.key_roles for kind in KINDS.values()})
    return control_endpoint(control, insecure=insecure)


def head_environment(settings: Settings, option: str, out: Path) -> dict[str, str]:
    """Return the environment in which the driver and the page show the same head.

    ``option`` overrides the settings. Otherwise, ``gateway.head`` may name another head for the
    page. The page's file of an avatar is written to the folder ``out``. Raises ``UserError`` if
    there is no such head, or the file cannot be written.
    """
    head = option or settings.load(DriverConfig).head
    environment = {variable_name("driver", "head"): head}
    if not option and settings.load(GatewayConfig).head not in (head, DEFAULT_HEAD):
        return environment
    if head in HEAD_NAMES:
        return environment | {variable_name("gateway", "head"): head}
    from kouxing.services.driver.head.glb_export import export_glb
    from kouxing.services.driver.render.scene import load_head

    page_head = (out / "head.glb").absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot create {out}: {error.strerror}; set driver.out") from None
    export_glb(load_head(head), page_head)
    return environment | {variable_name("gateway", "head"): str(page_head)}


def token_environment(settings: Settings) -> dict[str, str]:
    """Return the environment that keeps the page's token when the gateway restarts."""
    gateway = settings.load(GatewayConfig)
    if gateway.token or not (token := gateway.page_token()):
        return {}
    return {variable_name("gateway", "token"): token}


def assigned_environment(assignments: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables of ``--set``, which override all other sources.

    A service's own value overrides a common one.
    """
    environment = {}
    common_first = sorted(
        assignments.items(), key=lambda item: not item[0].startswith(f"{COMMON}.")
    )
    for name, value in common_first:
        table, _, key = name.partition(".")
        for service, config_type in CONFIG_TYPES.items():
            if service == table or (table == COMMON and key in key_types(config_type)):
                environment[variable_name(service, key)] = value
    return environment


def _port_warning(settings: Settings, free_ports: Mapping[str, str], control: str) -> str:
    """Return a message about default ports that are in use, or an empty string."""
    taken = [
        setting.text
        for kind in KINDS.values()
        for setting in settings.describe(kind.config_type)
        if setting.is_default and variable_name(kind.name, setting.key) in free_ports
    ]
    running = running_systems() if BOUND_CONTROL_VARIABLE in free_ports else []
    if running:
        owner = f"another kouxing is running, with control at {running[0].address}"
    else:
        owner = f"other programs use {', '.join(taken)}"
    warnings = [f"{owner}; this kouxing uses free ports"] if taken else []
    if BOUND_CONTROL_VARIABLE in free_ports:
        warnings.append(
            "commands run by this user connect to this system; in other environments, set"
            f" KOUXING_CONTROL={control}"
        )
    return "; ".join(warnings)


def _open_browser(page: str) -> None:
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if has_display or sys.platform == "darwin":
        webbrowser.open(page)


def _open_sample(path: Path, track: int | None, video: Path) -> AudioSource:
    """Open the file to play, and remove the video of the last one."""
    from kouxing.shared.audio.audio_file import open_audio

    if path.exists() and video.exists() and video.samefile(path):
        raise UserError(f"{path}: the video would overwrite this file; rename it first")
    sample = open_audio(path, track=track)
    video.unlink(missing_ok=True)
    return sample


def _play_sample(sample: AudioSource, control: str) -> None:
    from kouxing.services.cli.system.streaming import stream

    summary = stream(sample, control, session=_SAMPLE_SESSION, record=True)
    print_message(
        f"spoke {sample.name}: {plural(summary.num_phones, 'phone')} in {summary.duration_s:.1f} s"
    )
    if not summary.video:
        raise UserError("no video was written; see the messages above")
    print_message(f"wrote {summary.video}")
