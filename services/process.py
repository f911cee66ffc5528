"""A service as a process: read the configuration, run, and say how it ended.

What takes long to import is imported once Ctrl-C gives no traceback any more.
"""

from __future__ import annotations

import argparse
import pkgutil
import signal
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kouxing.shared.service import Service


def serve(name: str, file: Path | None, assignments: Iterable[str]) -> int:
    """Run a service to its end; return the exit status.

    Parameters
    ----------
    name
        One of ``kouxing.services.kinds.KINDS``.
    file
        A TOML file, if there is one.
    assignments
        Values from the command line, ``KEY=VALUE`` each.

    Raises
    ------
    UserError
        If the configuration is wrong.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while it starts is no error
    from kouxing.services.kinds import KINDS, read_settings
    from kouxing.shared.config import parse_assignments
    from kouxing.shared.service import run_service

    kind = KINDS[name]
    config = read_settings(file).load(kind.config_type, parse_assignments(assignments))
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # peers come and go

    def make() -> Service:
        service: Service = pkgutil.resolve_name(kind.service)(config)
        return service

    return run_service(make, name, config.log_level)


def run_module(name: str) -> None:
    """Run one service, as ``python -m kouxing.services.<name>`` does."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from kouxing.services.kinds import KINDS
    from kouxing.shared.errors import UserError

    parser = argparse.ArgumentParser(
        prog=f"python -m kouxing.services.{name}", description=KINDS[name].summary
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file.")
    parser.add_argument(
        "--set", action="append", metavar="KEY=VALUE", default=[], help="Set one key."
    )
    arguments = parser.parse_args()
    try:
        status = serve(name, arguments.config, arguments.set)
    except UserError as error:
        print(f"{name}: {error}", file=sys.stderr)
        status = 2
    sys.exit(status)
