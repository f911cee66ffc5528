"""Holds back a browser that sends more than it may: nothing is lost, it waits."""

from __future__ import annotations

import asyncio
import time


class Pace:
    """Keeps what comes from one browser to real time, after a burst.

    Parameters
    ----------
    burst_s
        How far it may be ahead: what a network that was away for a while brings at once.
    """

    def __init__(self, burst_s: float) -> None:
        self._burst_s = burst_s
        self._free_s = 0.0  # when all that has come would be over, had it come in real time

    async def keep(self, duration_s: float) -> None:
        """Take something of a duration; return when more may come."""
        now_s = time.monotonic()
        self._free_s = max(self._free_s, now_s) + duration_s
        await asyncio.sleep(max(0.0, self._free_s - now_s - self._burst_s))
