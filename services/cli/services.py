"""One command per kind of service."""

from __future__ import annotations

import sys
from collections.abc import Callable

from kouxing.services.cli.options import Assignments, ConfigFile
from kouxing.shared.service_kind import ServiceKind


def service_command(kind: ServiceKind) -> Callable[..., None]:
    """Return the command that runs a service of this kind."""

    def command(config: ConfigFile = None, assignments: Assignments = None) -> None:
        from kouxing.services.process import serve

        sys.exit(serve(kind.name, config, assignments or []))

    return command
