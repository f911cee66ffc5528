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

from kouxing.shared.service import PARENT_VARIABLE, PULSE_VARIABLE

POLL_S = 0.2  # between two checks of a process
HANG_S = 5.0  # a loop that sends no heartbeat for longer hangs


class HangDetector:
    """Detects that a service sends no heartbeats anymore.

    Call ``hangs`` about every ``POLL_S``. Of a longer pause between two calls only
    ``2 * POLL_S`` count, because then this process itself did not run.
    """

    def __init__(self, limit_s: float, now_s: float) -> None:
        self._limit_s = limit_s
        self._checked_s = now_s
        self._silent_s = 0.0
        self._is_ready = False

    def hangs(self, has_beaten: bool, now_s: float) -> bool:
        """Return whether the service has been silent too long since its first heartbeat."""
        self._silent_s += min(now_s - self._checked_s, 2 * POLL_S)
        self._checked_s = now_s
        if has_beaten or not self._is_ready:
            self._silent_s = 0.0
        self._is_ready = self._is_ready or has_beaten
        return self._silent_s > self._limit_s


class ServiceProcess(subprocess.Popen[bytes]):
    """Runs ``python -m kouxing.services.<kind>``. It ends when this process ends.

    ``environment`` is complete but for two variables. A loop that sends no heartbeat for
    ``hang_limit_s`` hangs. Other options are those of ``subprocess.Popen``.
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
        self._detector = HangDetector(hang_limit_s, time.monotonic())

    def hangs(self) -> bool:
        """Return whether the service's loop hangs. Call this about every ``POLL_S``."""
        beats = b""
        with contextlib.suppress(BlockingIOError):
            beats = os.read(self._pulse, 65536)
        return self._detector.hangs(bool(beats), time.monotonic())
