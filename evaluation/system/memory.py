"""Memory growth of a process of this user. Linux only."""

from __future__ import annotations

import time
from pathlib import Path


class Memory:
    """Memory of a process, relative to when this object was made; MB of 2^20 bytes."""

    def __init__(self, process_id: int) -> None:
        self._folder = Path(f"/proc/{process_id}")
        (self._folder / "clear_refs").write_text("5")  # resets the peak
        self._start_mb = self._read_mb("VmRSS")

    @property
    def growth_mb(self) -> float:
        """Peak growth since the start."""
        return self._read_mb("VmHWM") - self._start_mb

    @property
    def kept_mb(self) -> float:
        """Growth at present."""
        return self._read_mb("VmRSS") - self._start_mb

    def wait_until_kept(self, limit_mb: float, timeout_s: float = 10.0) -> bool:
        """Wait until ``kept_mb`` is at most ``limit_mb``; return False after the timeout."""
        end_s = time.monotonic() + timeout_s
        while self.kept_mb > limit_mb:
            if time.monotonic() > end_s:
                return False
            time.sleep(0.05)
        return True

    def _read_mb(self, name: str) -> float:
        lines = (self._folder / "status").read_text("ascii").splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith(f"{name}:"))) / 1024
