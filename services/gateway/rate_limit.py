"""A limit on how fast one browser may send. Excess data waits; no data is lost."""

from __future__ import annotations

import asyncio

BURST_S = 5.0  # allowed lead over real time; a network that stalled delivers a burst
COMMAND_S = 0.05  # a command costs as much as this duration of audio


class RateLimit:
    """Limits one browser's data to real time, after an initial burst."""

    def __init__(self) -> None:
        self._used_until_s = 0.0  # when all data so far would end if it had come in real time

    async def wait(self, duration_s: float) -> None:
        """Charge for data of a given duration; return when more may be read."""
        now_s = asyncio.get_running_loop().time()
        self._used_until_s = max(self._used_until_s, now_s) + duration_s
        await asyncio.sleep(max(0.0, self._used_until_s - now_s - BURST_S))
