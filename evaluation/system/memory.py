"""How much memory a process takes more than at some time."""

from __future__ import annotations

import time
from pathlib import Path


class Memory:
    """The growth of a process of this user since this was made; on Linux only."""

    def __init__(self, process: int) -> None:
        self._folder = Path(f"/proc/{process}")
        (self._folder / "clear_refs").write_text("5")  # the peak begins anew
        self._before_mb = self._read_mb("VmRSS")

    @property
    def growth_mb(self) -> float:
        """The most it took since, in MB of 2^20 bytes."""
        return self._read_mb("VmHWM") - self._before_mb

    @property
    def kept_mb(self) -> float:
        """What it takes now, in the same unit."""
        return self._read_mb("VmRSS") - self._before_mb

    def wait_until_kept(self, limit_mb: float, deadline_s: float = 10.0) -> bool:
        """Wait until it keeps no more than that; return whether it came to that."""
        end_s = time.monotonic() + deadline_s
        while self.kept_mb > limit_mb:
            if time.monotonic() > end_s:
                return False
            time.sleep(0.05)
        return True

    def _read_mb(self, name: str) -> float:
        lines = (self._folder / "status").read_text("ascii").splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith(f"{name}:"))) / 1024
