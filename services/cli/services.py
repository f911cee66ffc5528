"""One command per kind of service, and the options that services take."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from kouxing.services.kinds import ServiceKind

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="TOML file with one table per service.")
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set one key of the service; repeatable."),
]


def service_command(kind: ServiceKind) -> Callable[..., None]:
    """Return the command that runs a service of this kind."""

    def command(config: ConfigFile = None, assignments: Assignments = None) -> None:
        from kouxing.services.process import serve

        sys.exit(serve(kind.name, config, assignments or []))

    return command
