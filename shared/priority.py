"""How the system schedules a process that must be in time."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

NICENESS = -10  # enough for several times the processor time of an ordinary program
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
AUTOGROUP = Path("/proc/self/autogroup")


def use_one_thread() -> None:
    """Let numerical libraries use one thread: more need more time in total.

    Call this before they are imported.
    """
    os.environ.update(ONE_THREAD)


def raise_priority() -> None:
    """Let this process run before ordinary programs, if the system allows it.

    Call this before other threads start. Linux shares the processor among sessions first
    (autogroup), so a process that leads its session also raises the session.
    """
    if not hasattr(os, "setpriority"):  # Windows
        return
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):
            AUTOGROUP.write_text(str(NICENESS), encoding="ascii")
