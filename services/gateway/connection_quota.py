"""Limits on the number of connections, in total and from one address."""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator

from aiohttp import web

ADDRESS_SHARE = 0.75  # of the quota for one address; many people can share a proxy's address


class ConnectionQuota:
    """A limited number of connections of one kind.

    Parameters
    ----------
    capacity
        Maximum number of connections.
    kind
        Plural noun for error messages, such as ``viewers``.
    address_share
        Maximum fraction of ``capacity`` for one address; 1 if all clients come through a proxy.
    """

    def __init__(self, capacity: int, kind: str, address_share: float) -> None:
        self._capacity = capacity
        self._kind = kind
        self._max_per_address = math.ceil(address_share * capacity)
        self._num_open: Counter[str] = Counter()  # by address

    def acquire(self, address: str) -> bool:
        """Count a connection from an address; return False if a limit is reached."""
        if self._num_open.total() >= self._capacity:
            return False
        if self._num_open[address] >= self._max_per_address:
            return False
        self._num_open[address] += 1
        return True

    def release(self, address: str) -> None:
        """Stop counting a connection from an address."""
        self._num_open[address] -= 1
        if not self._num_open[address]:
            del self._num_open[address]

    @contextlib.contextmanager
    def hold(self, request: web.Request) -> Iterator[None]:
        """Count the connection of a request while the context is open.

        Raises
        ------
        web.HTTPServiceUnavailable
            If a limit is reached.
        """
        address = request.remote or ""
        if not self.acquire(address):
            text = (
                f"too many {self._kind}: {self._num_open.total()} of {self._capacity} are "
                f"connected, {self._num_open[address]} from your address (at most "
                f"{self._max_per_address}); close one or try again later\n"
            )
            raise web.HTTPServiceUnavailable(text=text)
        try:
            yield
        finally:
            self.release(address)
