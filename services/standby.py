"""A process that has imported what takes long, and becomes a service when it is told which.

``python -m kouxing.services.standby`` reads one line of JSON from standard input:
``{"service": NAME, "arguments": [...], "environment": {...}}``. So a service that crashed is back
without the time that Python takes for its libraries.
"""

from __future__ import annotations

import json
import os
import pkgutil
import signal
import sys

from kouxing.services.kinds import KINDS
from kouxing.services.process import run_module


def main() -> None:
    """Import, wait for the line, and run the service; end if there is no line."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    for kind in KINDS.values():
        pkgutil.resolve_name(kind.service)
    line = sys.stdin.readline()
    if not line:
        return
    order = json.loads(line)
    os.environ.update(order["environment"])
    sys.argv[1:] = order["arguments"]
    run_module(order["service"])


if __name__ == "__main__":
    main()
