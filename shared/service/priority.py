"""Raises the scheduling priority of real-time processes."""

import contextlib
import os
from pathlib import Path

NICENESS = -10  # several times the processor time of an ordinary program
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
AUTOGROUP = Path("/proc/self/autogroup")


def use_one_thread() -> None:
    """Limit numerical libraries to one thread, because more threads need more time in total.

    Call this before importing them.
    """
    os.environ.update(ONE_THREAD)


def raise_priority() -> None:
    """Raise the priority of this process above ordinary programs, if the system allows it.

    Call this before other threads start. Linux first divides the processor among process sessions
    (autogroups). A process that leads its session therefore also raises the session's priority.
    """
    if not hasattr(os, "setpriority"):  # Windows
        return
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):
            AUTOGROUP.write_text(str(NICENESS), encoding="ascii")
