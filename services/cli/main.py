"""The command ``kouxing``."""

import contextlib
import errno
import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points, version
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer.core import TyperGroup, TyperOption

from kouxing.services.cli import configuration
from kouxing.services.cli.export import app as export_app
from kouxing.services.cli.heads import app as head_app
from kouxing.services.cli.heads import ensure_page_heads
from kouxing.services.cli.keys import app as keys_app
from kouxing.services.cli.launch import cluster, run
from kouxing.services.cli.options import Assignments, ConfigFile, Panel
from kouxing.services.cli.recordings import commands as recordings
from kouxing.services.cli.system import commands as system
from kouxing.services.service_kinds import KINDS
from kouxing.shared.command.terminal import discard_output, print_message, replace_closed_streams
from kouxing.shared.errors import USER_ERROR, UserError
from kouxing.shared.files.output_file import write_error
from kouxing.shared.interrupt import clear_interrupt, is_interrupted
from kouxing.shared.service.service_kind import ServiceKind

_LINE_END = re.compile(r"(?<!\n)\n(?!\n)")  # within a paragraph
ENTRY_POINTS = "kouxing.commands"  # such as training and evaluation
_VALUE_NAMES = {"bool": "", "str": "TEXT", "path": "PATH", "int": "NUMBER", "float": "NUMBER"}
_RENDER_PANELS = {  # names of options
    "Speech": ("text", "language", "track", "live"),
    "Lips": ("lips", "mouth", "expressiveness"),
    "Picture": ("head", "size", "background", "camera", "rate", "captions", "speed", "at"),
    "Curves": ("curve_format", "sound"),
}
_UsageError: Any = typer.BadParameter.__base__  # typer does not export it
_PYTHON_TYPE = re.compile(r"<(?:list\[)?(\w+)(?: range)?\]?>")


class CommandGroup(TyperGroup):
    """The commands of this package, and those that other packages add as entry points.

    Entry points are imported only for their own commands and for the list of all commands.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, in the order of their panels."""
        self._add_entry_points()
        order = {panel.value: number for number, panel in enumerate(Panel)}
        commands: Mapping[str, Any] = self.commands
        return sorted(
            commands, key=lambda name: order.get(commands[name].rich_help_panel, len(order))
        )

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, or None."""
        if cmd_name not in self.commands:
            self._add_entry_points()
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            _simplify_help(command, ctx)
        if cmd_name == "render":
            _group_options(command, _RENDER_PANELS)
        return command

    def get_params(self, ctx: Any) -> Any:
        """Return the options of the group itself."""
        parameters = super().get_params(ctx)
        _name_values(parameters, ctx)
        return parameters

    def _add_entry_points(self) -> None:
        for entry_point in entry_points(group=ENTRY_POINTS):
            if entry_point.name not in self.commands:
                command: Any = typer.main.get_command(entry_point.load())
                command.name = entry_point.name
                command.rich_help_panel = command.rich_help_panel or Panel.MEASURE
                self.add_command(command)


def _group_options(command: Any, panels: Mapping[str, Sequence[str]]) -> None:
    for parameter in command.params:
        for panel, names in panels.items():
            if parameter.name in names:
                parameter.rich_help_panel = panel


def _simplify_help(command: Any, ctx: Any) -> None:
    """Let the help of a command and of its subcommands fill the lines, without Python's types."""
    command.help = command.help and _LINE_END.sub(" ", inspect.cleandoc(command.help))
    _name_values(command.get_params(ctx), ctx)
    for subcommand in getattr(command, "commands", {}).values():
        _simplify_help(subcommand, ctx)


def _name_values(parameters: Any, ctx: Any) -> None:
    """Show TEXT or PATH in the help of options instead of Python's types.

    Flags and arguments show nothing: their names are enough.
    """
    for parameter in parameters:
        if not isinstance(parameter, TyperOption):
            parameter.display_type = lambda ctx: ""
        elif parameter.metavar is None and (
            python_type := _PYTHON_TYPE.fullmatch(parameter.display_type(ctx))
        ):
            parameter.metavar = _VALUE_NAMES.get(python_type[1].lower())


app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(f"kouxing {version('kouxing')}")
        raise typer.Exit


@app.callback()
def kouxing(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Live speech in, a talking 3-D face out."""


def _service_command(kind: ServiceKind) -> Callable[..., None]:
    def command(config: ConfigFile = None, assignments: Assignments = None) -> None:
        from kouxing.services.process import serve

        if kind.name == "gateway":
            ensure_page_heads()
        sys.exit(serve(kind.name, config, assignments or []))

    return command


_COMMANDS: Mapping[Panel, Sequence[Callable[..., None]]] = {
    Panel.RUN: (
        run.run, system.speak, system.listen, system.send, system.express, system.devices,
        system.status, system.doctor, configuration.config, cluster.cluster,
    ),
    Panel.RECORDINGS: (recordings.render, recordings.lips, recordings.phones, recordings.align),
}  # fmt: skip
for panel, commands in _COMMANDS.items():
    for command in commands:
        app.command(rich_help_panel=panel)(command)
app.add_typer(keys_app, name="keys", rich_help_panel=Panel.RUN)
app.add_typer(head_app, name="head", rich_help_panel=Panel.RECORDINGS)
app.add_typer(export_app, name="export", rich_help_panel=Panel.RECORDINGS)
for kind in KINDS.values():
    add = app.command(kind.name, help=kind.summary, rich_help_panel=Panel.SERVICES)
    add(_service_command(kind))


def main() -> None:
    """Run the command line. A user error gives one line on standard error and exit status 2.

    Ctrl-C gives exit status 130, whatever exception a library turns it into. Python's shutdown is
    skipped, because native libraries can hang or crash during a shutdown.
    """
    replace_closed_streams()
    if isinstance(sys.stdout, TextIOWrapper):  # flush each line also in a log file
        sys.stdout.reconfigure(line_buffering=True, errors="backslashreplace")
    try:
        _run_command()
    except (Exception, KeyboardInterrupt, SystemExit):
        if not is_interrupted():
            raise
    if is_interrupted():
        clear_interrupt()
        with contextlib.suppress(OSError):
            sys.stdout.flush()
        os._exit(130)


def _run_command() -> None:
    try:
        if "" in sys.argv[1:]:
            raise UserError("an argument is empty; perhaps a shell variable is not set")
        # app() would replace sys.excepthook
        status = typer.main.get_command(app)(prog_name="kouxing", standalone_mode=False)
    except UserError as error:
        if is_interrupted():
            raise
        text = str(error)
    except _UsageError as error:
        text = _usage_text(error)
    except typer.Abort:
        print_message("kouxing: aborted; nothing was written")
        sys.exit(1)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        text = str(write_error(Path(error.filename or "the output"), error))
        discard_output()
    else:
        sys.exit(status or 0)
    if text:
        print_message(f"kouxing: {text}", "red")
    sys.exit(USER_ERROR)


def _usage_text(error: Any) -> str:
    """Return what is wrong with a command line; empty if the help was printed instead."""
    if text := _number_text(error):
        return text
    problem = error.format_message().removesuffix(".").replace("Value error, ", "")
    command = error.ctx.command_path if error.ctx else "kouxing COMMAND"
    option, group = getattr(error, "option_name", None), error.ctx and error.ctx.parent
    if group and any(option in parameter.opts for parameter in group.command.params):
        path = group.command_path
        return f"{option} is an option of {path}; write {path} {option} {error.ctx.info_name}"
    link = " See" if problem.endswith("?") else "; see"  # click asks "Did you mean ...?"
    return problem and f"{problem[0].lower()}{problem[1:]}{link} {command} -h"


def _number_text(error: Any) -> str:
    """Return what an option with a wrong number allows; empty for other errors."""
    parameter, refused = getattr(error, "param", None), error.__cause__
    if not isinstance(parameter, TyperOption) or not hasattr(refused, "errors"):
        return ""
    kind = parameter.type_descriptor.annotation
    allowed = {int: "an integer", float: "a number"}.get((get_args(kind) or (kind,))[0])
    if allowed is None:
        return ""
    if parameter.max is not None:
        allowed += f" from {parameter.min:g} to {parameter.max:g}"
    elif parameter.min is not None:
        allowed += f" of at least {parameter.min:g}"
    return f"{parameter.opts[0]} {refused.errors()[0]['input']}: use {allowed}"
