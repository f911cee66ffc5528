"""Runs a service as a child process, which reports each heartbeat through a pipe."""

import contextlib
import os
import subprocess
import sys
import time
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from kouxing.shared.clock import StallDetector
from kouxing.shared.service.base import HEARTBEAT_S, IDLE_HEARTBEAT_S
from kouxing.shared.service.parent_process import (
    HEARTBEAT_PIPE_VARIABLE,
    IDLE_HEARTBEAT,
    PARENT_VARIABLE,
)

POLL_S = 0.5  # interval between checks of a process
UNRESPONSIVE_S = 1.0  # a loop that sends no heartbeat for longer may hang
HANG_S = 5.0  # a loop that sends no heartbeat for longer hangs


class ServiceProcess(subprocess.Popen[bytes]):
    """Runs ``python -m kouxing.services.process KIND``. It ends when this process ends.

    ``environment`` is complete except for two variables. A loop counts as hung if it sends no
    heartbeat for ``hang_limit_s``. The limit is 0.75 s longer after ``IDLE_HEARTBEAT``. Other
    options have the types of ``subprocess.Popen``.
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
        self._heartbeats, write_end = os.pipe()
        weakref.finalize(self, os.close, self._heartbeats)
        for end in (self._heartbeats, write_end):
            os.set_blocking(end, False)
        added = {PARENT_VARIABLE: str(os.getpid()), HEARTBEAT_PIPE_VARIABLE: str(write_end)}
        try:
            super().__init__(
                [sys.executable, "-m", "kouxing.services.process", kind, *arguments],
                env={**environment, **added},
                pass_fds=(write_end,),
                **options,
            )
        finally:
            os.close(write_end)
        self._hang_limit_s = hang_limit_s
        self._heartbeat_gap = HeartbeatGapMeter(time.monotonic())
        self._idle_s = 0.0  # extra time until the next heartbeat of a service without sessions
        self.is_ready = False  # whether the process has sent a heartbeat

    def read_heartbeats(self) -> None:
        """Update the state of the process. Call this about every ``POLL_S``."""
        self._heartbeat_gap.update(time.monotonic(), self._waited_s())
        with contextlib.suppress(BlockingIOError):
            if heartbeats := os.read(self._heartbeats, 65536):
                self.reset_heartbeat_gap()
                self.is_ready = True
                is_idle = heartbeats.endswith(IDLE_HEARTBEAT)
                self._idle_s = IDLE_HEARTBEAT_S - HEARTBEAT_S if is_idle else 0.0

    @property
    def is_unresponsive(self) -> bool:
        """Whether a heartbeat is missing."""
        return self._heartbeat_gap.duration_s > UNRESPONSIVE_S + self._idle_s

    def reset_heartbeat_gap(self) -> None:
        """Restart the timeout as if a heartbeat had arrived."""
        self._heartbeat_gap.duration_s = 0.0

    @property
    def is_hung(self) -> bool:
        """Whether the service's loop hangs, or the process is stopped."""
        return self.is_ready and self._heartbeat_gap.duration_s > self._hang_limit_s + self._idle_s

    def _waited_s(self) -> float:
        """Return how long the main thread has waited for a processor; 0 if unknown."""
        try:
            waited_ns = Path(f"/proc/{self.pid}/schedstat").read_text("ascii").split()[1]
        except (OSError, IndexError):
            return 0.0
        return int(waited_ns) / 1e9


class HeartbeatGapMeter:
    """Measures the time in which a loop could run but sent no heartbeat, in seconds."""

    def __init__(self, now_s: float) -> None:
        self.duration_s = 0.0
        self._stall = StallDetector(now_s, min_stall_s=2 * POLL_S)  # detects stalls of the caller
        self._waited_s = 0.0

    def update(self, now_s: float, waited_s: float) -> None:
        """Add the time since the last call.

        ``waited_s`` is the total time in which the loop waited for a processor.
        """
        elapsed_s, waited_s = self._stall.elapsed_s(now_s), max(waited_s, self._waited_s)
        self.duration_s += max(0.0, elapsed_s - (waited_s - self._waited_s))
        self._waited_s = waited_s
