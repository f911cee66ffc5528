"""A service as a child process. The service reports each heartbeat through a pipe."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
import weakref
from collections.abc import Iterable, Mapping
from typing import Any

from kouxing.shared.clock import StallDetector
from kouxing.shared.service import (
    HEARTBEAT_S,
    IDLE_HEARTBEAT_S,
    IDLE_PULSE,
    PARENT_VARIABLE,
    PULSE_VARIABLE,
)

POLL_S = 0.5  # between two checks of a process
HANG_S = 5.0  # a loop that sends no heartbeat for longer hangs


class ServiceProcess(subprocess.Popen[bytes]):
    """Runs ``python -m kouxing.services.<kind>``. It ends when this process ends.

    ``environment`` is complete but for two variables. A loop that sends no heartbeat for
    ``hang_limit_s`` hangs; without sessions, for 0.75 s longer. Other options are those of
    ``subprocess.Popen``.
    """

    def __init__(
        self,
        kind: str,
        arguments: Iterable[str] = (),
        *,
        environment: Mapping[str, str],
        hang_limit_s: float = HANG_S,
        **options: Any,
    ) -> None:
        self._pulse, write_end = os.pipe()
        weakref.finalize(self, os.close, self._pulse)
        for end in (self._pulse, write_end):
            os.set_blocking(end, False)
        added = {PARENT_VARIABLE: str(os.getpid()), PULSE_VARIABLE: str(write_end)}
        try:
            super().__init__(
                [sys.executable, "-m", f"kouxing.services.{kind}", *arguments],
                env={**environment, **added},
                pass_fds=(write_end,),
                **options,
            )
        finally:
            os.close(write_end)
        self._hang_limit_s = hang_limit_s
        self._stall = StallDetector(time.monotonic(), limit_s=2 * POLL_S)
        self._silent_s = 0.0
        self._idle_s = 0.0  # by which the next heartbeat may be later
        self.is_ready = False  # it has sent a heartbeat

    def hangs(self) -> bool:
        """Return whether the service's loop hangs. Call this about every ``POLL_S``."""
        self._silent_s += self._stall.elapsed_s(time.monotonic())
        with contextlib.suppress(BlockingIOError):
            if pulses := os.read(self._pulse, 65536):
                self._silent_s, self.is_ready = 0.0, True
                is_idle = pulses.endswith(IDLE_PULSE)
                self._idle_s = IDLE_HEARTBEAT_S - HEARTBEAT_S if is_idle else 0.0
        return self.is_ready and self._silent_s > self._hang_limit_s + self._idle_s
