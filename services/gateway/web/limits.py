"""Limits on the number of connections, in total and from one address, and on their data."""

import asyncio
import contextlib
import math
from collections import Counter
from collections.abc import Iterator

from aiohttp import web

from kouxing.shared.clock import CLIENT_CLOCK_RATE

BURST_S = 5.0  # allowed lead over real time; a network that stalled delivers a burst
COMMAND_S = 0.05  # a command uses this much of its limit


class ConnectionQuota:
    """Limits the connections of one kind, a plural noun such as ``viewers``.

    One address may hold at most ``address_share`` of ``capacity``.
    """

    def __init__(self, capacity: int, kind: str, address_share: float) -> None:
        self._capacity = capacity
        self._kind = kind
        self._max_per_address = math.ceil(address_share * capacity)
        self._num_open: Counter[str] = Counter()  # by address

    @contextlib.contextmanager
    def hold(self, request: web.Request) -> Iterator[None]:
        """Count the connection of a request while the context is open.

        Raises ``web.HTTPServiceUnavailable`` if a limit is reached.
        """
        address = request.remote or ""
        total, num_own = self._num_open.total(), self._num_open[address]
        if total >= self._capacity or num_own >= self._max_per_address:
            text = (
                f"too many {self._kind}: {total} of {self._capacity} are connected, {num_own} from"
                f" your address (at most {self._max_per_address}); close one or try again later\n"
            )
            raise web.HTTPServiceUnavailable(text=text)
        self._num_open[address] += 1
        try:
            yield
        finally:
            self._num_open[address] -= 1
            if not self._num_open[address]:
                del self._num_open[address]


class RealTimeLimit:
    """Limits one browser's data to real time on its clock, after an initial burst."""

    def __init__(self) -> None:
        self._used_until_s = 0.0  # when all data so far would end in real time

    def admit(self, duration_s: float) -> bool:
        """Charge for data of a given duration; return False if it must be dropped instead."""
        now_s = asyncio.get_running_loop().time()
        used_until_s = max(self._used_until_s, now_s) + duration_s / CLIENT_CLOCK_RATE
        if used_until_s > now_s + BURST_S:
            return False
        self._used_until_s = used_until_s
        return True

    async def wait(self, duration_s: float) -> None:
        """Charge for data of a given duration; return when more may be read."""
        now_s = asyncio.get_running_loop().time()
        self._used_until_s = max(self._used_until_s, now_s) + duration_s / CLIENT_CLOCK_RATE
        await asyncio.sleep(max(0.0, self._used_until_s - now_s - BURST_S))
