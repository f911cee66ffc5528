"""How many clients may be connected at once: in all, and from one address."""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator

from aiohttp import web

ADDRESS_SHARE = 0.75  # of the places, for one address: many people may come through one proxy


class Places:
    """Places for clients of one kind.

    Parameters
    ----------
    number
        How many there are.
    what
        The kind, for messages: ``viewers``.
    share
        How many of them one address may have; 1 where all come through a proxy.
    """

    def __init__(self, number: int, what: str, share: float) -> None:
        self._number = number
        self._what = what
        self._max_of_address = math.ceil(share * number)
        self._taken: Counter[str] = Counter()  # by address

    def take(self, address: str) -> bool:
        """Take a place, if there is one for this address."""
        is_full = self._taken.total() >= self._number
        if is_full or self._taken[address] >= self._max_of_address:
            return False
        self._taken[address] += 1
        return True

    def leave(self, address: str) -> None:
        """Give a place back."""
        self._taken[address] -= 1
        if not self._taken[address]:
            del self._taken[address]

    @contextlib.contextmanager
    def held(self, request: web.Request) -> Iterator[None]:
        """Hold a place for whoever asks.

        Raises
        ------
        web.HTTPServiceUnavailable
            If there is none.
        """
        address = request.remote or ""
        if not self.take(address):
            text = (
                f"{self._taken.total()} of {self._number} {self._what} are connected, "
                f"{self._taken[address]} from your address; one has up to {self._max_of_address}\n"
            )
            raise web.HTTPServiceUnavailable(text=text)
        try:
            yield
        finally:
            self.leave(address)
