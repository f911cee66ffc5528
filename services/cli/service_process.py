"""A service as a child process that shows whether its loop runs.

The service writes a byte into a pipe with each heartbeat. On a busy machine a living one may be
silent for seconds, because it gets no processor. So silence alone says little: a loop hangs if its
process is stopped, or if it has worked for long meanwhile.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from kouxing.shared.service import PARENT_VARIABLE, PULSE_VARIABLE

LOOK_S = 0.2  # between looks at a process
SILENT_S = 0.7  # at least, without a heartbeat
WORKED_S = 0.7  # of processor time between two heartbeats is too much for a worker
BLOCKED_S = 5.0  # without a heartbeat, whatever the reason
_TICKS_HZ = os.sysconf("SC_CLK_TCK")
_STATE, _USER, _KERNEL = 0, 11, 12  # fields of Linux' file stat, after the program's name


class ServiceProcess(subprocess.Popen[bytes]):
    """Runs ``python -m kouxing.services.<module>``; it ends when this process does.

    Parameters
    ----------
    module
        Name of the service, or ``standby``.
    environment
        All of it, but for what this class adds.
    options
        As ``subprocess.Popen`` takes them.
    """

    def __init__(
        self,
        module: str,
        arguments: Iterable[str] = (),
        *,
        environment: Mapping[str, str],
        **options: Any,
    ) -> None:
        self._pulse, written = os.pipe()
        weakref.finalize(self, os.close, self._pulse)
        for end in (self._pulse, written):
            os.set_blocking(end, False)
        own = {PARENT_VARIABLE: str(os.getpid()), PULSE_VARIABLE: str(written)}
        try:
            super().__init__(
                [sys.executable, "-m", f"kouxing.services.{module}", *arguments],
                env={**environment, **own},
                pass_fds=(written,),
                **options,
            )
        finally:
            os.close(written)
        self._is_ready = False  # a heartbeat came
        self._looked_s = time.monotonic()
        self._silent_s = 0.0
        self._worked_s = 0.0  # processor time at the newest heartbeat

    def hangs(self, worked_s: float) -> bool:
        """Return whether its loop stands still, and not for want of a processor.

        To be called about every ``LOOK_S``: what is longer between two calls does not count, as
        then this process stood still.

        Parameters
        ----------
        worked_s
            How much processor time its loop may take between two heartbeats.
        """
        now_s = time.monotonic()
        passed_s, self._looked_s = min(now_s - self._looked_s, 2 * LOOK_S), now_s
        state, loop_s = _main_thread(self.pid)
        beats = b""
        with contextlib.suppress(BlockingIOError):
            beats = os.read(self._pulse, 65536)
        self._is_ready = self._is_ready or bool(beats)
        if beats or not self._is_ready:
            self._silent_s, self._worked_s = 0.0, loop_s
            return False
        self._silent_s += passed_s
        return self._silent_s > SILENT_S and (
            state == "T" or loop_s - self._worked_s > worked_s or self._silent_s > BLOCKED_S
        )


def _main_thread(number: int) -> tuple[str, float]:
    """Return the state of a process's main thread and its processor time, s; known on Linux."""
    try:
        text = Path(f"/proc/{number}/task/{number}/stat").read_text("utf-8")
    except OSError:
        return "", 0.0
    fields = text.rpartition(")")[2].split()
    return fields[_STATE], (int(fields[_USER]) + int(fields[_KERNEL])) / _TICKS_HZ
