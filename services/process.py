"""Runs a service as a process: ``python -m kouxing.services.process KIND``.

Slow imports are inside functions, so that they run after Ctrl-C is set up to exit without a
traceback.
"""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kouxing.shared.service.base import Service


def serve(name: str, file: Path | None, assignments: Iterable[str]) -> int:
    """Run one of ``KINDS`` with ``KEY=VALUE`` assignments; return the exit status.

    Raises ``UserError`` if the configuration is invalid.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during startup prints no traceback
    from kouxing.shared.service.priority import raise_priority, use_one_thread

    use_one_thread()
    from kouxing.services.service_kinds import KINDS, read_settings
    from kouxing.shared.settings.config import parse_assignments

    kind = KINDS[name]
    if kind.role != "observer":  # observers draw pictures or start other programs
        raise_priority()
    config = read_settings(file, parse_assignments(assignments, name)).load(kind.config_type)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # a closed connection is not fatal
    return run_service(lambda: kind.service_type(config), name, config.log_level)


def run_service(make_service: Callable[[], Service], name: str, log_level: str) -> int:
    """Run a service; return the exit status.

    An invalid setting prints one line and returns 2. An internal error logs a traceback and
    returns 1.
    """
    from kouxing.shared.errors import USER_ERROR, UserError, prefix_name
    from kouxing.shared.monitoring.logs import LOG, configure
    from kouxing.shared.monitoring.metrics import use_single_malloc_arena
    from kouxing.shared.network.connection_limits import raise_file_limit
    from kouxing.shared.service.parent_process import PARENT_VARIABLE

    configure(name, log_level)
    use_single_malloc_arena()
    raise_file_limit()
    try:
        service = make_service()
        service.startup()
    except ImportError as error:
        print(f"{name}: {error}; install kouxing again (in a checkout: make)", file=sys.stderr)
        return USER_ERROR
    except UserError as error:
        print(prefix_name(name, str(error)), file=sys.stderr)
        return USER_ERROR
    try:
        service.run()
    except Exception:  # at this point, even a UserError is an internal error
        LOG.critical("internal error", exc_info=True, extra={"session": service.current_session})
        return 1
    if service.has_new_key:
        if PARENT_VARIABLE in os.environ:
            return 1  # the supervisor starts it again
        os.execv(sys.executable, sys.orig_argv)  # noqa: S606 - this program again
    return 0


def main() -> None:
    """Run the service named on the command line; starts faster than ``kouxing KIND``."""
    gc.disable()  # until the service runs: it frees nothing, and takes a tenth of the startup time
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from kouxing.services.service_kinds import KINDS
    from kouxing.shared.errors import USER_ERROR, UserError, prefix_name

    parser = argparse.ArgumentParser(prog="python -m kouxing.services.process")
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file.")
    parser.add_argument(
        "--set", action="append", metavar="KEY=VALUE", default=[], help="Set one key."
    )
    arguments = parser.parse_args()
    try:
        status = serve(arguments.kind, arguments.config, arguments.set)
    except UserError as error:
        print(prefix_name(arguments.kind, str(error)), file=sys.stderr)
        status = USER_ERROR
    sys.exit(status)


if __name__ == "__main__":
    main()
