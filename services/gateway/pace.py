"""Holds back a browser that sends more than it may: nothing is lost, it waits."""

from __future__ import annotations

import asyncio
import time

BURST_S = 5.0  # that it may be ahead: what a network that was away for a while brings at once
COMMAND_S = 0.05  # a command counts as much as so much audio


class Pace:
    """Keeps what comes from one browser to real time, after a burst."""

    def __init__(self) -> None:
        self._free_s = 0.0  # when all that has come would be over, had it come in real time

    async def keep(self, duration_s: float) -> None:
        """Take something of a duration; return when more may come."""
        now_s = time.monotonic()
        self._free_s = max(self._free_s, now_s) + duration_s
        await asyncio.sleep(max(0.0, self._free_s - now_s - BURST_S))
