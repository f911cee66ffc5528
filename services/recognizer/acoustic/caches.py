"""What a network remembers of the sessions that it serves: keys and values of earlier positions.

A network takes the caches of all sessions in a run as one array. To keep nothing twice for that,
caches lie side by side from the start. Sessions that run together and are no neighbours change
places, and mostly stay so, since sound comes in the same order again.
"""

from __future__ import annotations

import mmap
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NUM_PLACES = 16  # on a shelf

Halves = NDArray[np.float16]


@dataclass(frozen=True, slots=True)
class CacheSizes:
    """Sizes of a session's cache."""

    rings: int  # keys of all layers, then values
    heads: int
    slots: int  # positions in a ring
    head_size: int

    @property
    def num_bytes(self) -> int:
        """Memory of a cache, in 16 bits a number."""
        return 2 * self.rings * self.heads * self.slots * self.head_size


def cache_names(num_layers: int) -> list[str]:
    """Return the names of a network's inputs that are its caches, in the order of the rings."""
    return [f"{kind}_{layer}" for kind in ("keys", "values") for layer in range(num_layers)]


class Cache:
    """Keys and values of a session; its place is free once nobody has it any more.

    What was not written yet may be of a session before it, and must be masked.
    """

    __slots__ = ("__weakref__", "place", "shelf")

    def __init__(self, shelf: Shelf, place: int) -> None:
        self.shelf = shelf
        self.place = place  # on the shelf

    @property
    def rings(self) -> Halves:
        """Keys and values, (rings, heads, slots, size); what is written there stays."""
        return self.shelf.rings[:, self.place]


class CacheMemory:
    """The caches of all sessions that a network serves.

    Parameters
    ----------
    sizes
        Of each cache.
    max_batch
        Sessions in a run, at most 16.
    """

    def __init__(self, sizes: CacheSizes, max_batch: int) -> None:
        self._sizes = sizes
        self._max_batch = max_batch
        self._shelves: list[weakref.ref[Shelf]] = []

    def open(self) -> Cache:
        """Return a cache for one more session."""
        shelves = [shelf for each in self._shelves if (shelf := each()) is not None]
        shelf = next((each for each in shelves if each.has_room), None)
        if shelf is None:
            shelf = Shelf(self._sizes)
            shelves.append(shelf)
        self._shelves = [weakref.ref(each) for each in shelves]
        return shelf.open()

    def runs(self, caches: Sequence[Cache]) -> Iterator[tuple[list[int], Halves]]:
        """Yield the runs that serve sessions with these caches.

        Yields
        ------
        tuple
            Numbers of the sessions of a run, in the order of their rows; their keys and values,
            (rings, sessions, heads, slots, size), where they stay until the next run.
        """
        numbers: dict[Shelf, list[int]] = {}
        for number, cache in enumerate(caches):
            numbers.setdefault(cache.shelf, []).append(number)
        for shelf, own in numbers.items():
            first = shelf.gather([caches[number] for number in own])
            own.sort(key=lambda number: caches[number].place)
            for begin in range(0, len(own), self._max_batch):
                batch = own[begin : begin + self._max_batch]
                place = first + begin
                yield batch, shelf.rings[:, place : place + len(batch)]


class Shelf:
    """Places for caches beside each other; those that are free take no memory.

    Attributes
    ----------
    rings
        Shape (rings, places, heads, slots, size).
    """

    def __init__(self, sizes: CacheSizes) -> None:
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
        self._memory = mmap.mmap(-1, NUM_PLACES * sizes.num_bytes, flags=flags)
        shape = (sizes.rings, NUM_PLACES, sizes.heads, sizes.slots, sizes.head_size)
        self.rings = np.frombuffer(self._memory, np.float16).reshape(shape)
        self._caches: list[weakref.ref[Cache] | None] = [None] * NUM_PLACES

    @property
    def has_room(self) -> bool:
        """Whether a place is free."""
        return None in self._caches

    def open(self) -> Cache:
        """Return a cache at a free place."""
        cache = Cache(self, self._caches.index(None))
        self._caches[cache.place] = weakref.ref(cache, self._on_gone)
        return cache

    def gather(self, caches: Sequence[Cache]) -> int:
        """Let caches be neighbours; return the first one's place."""
        places = {cache.place for cache in caches}
        num = len(places)
        first = max(
            range(NUM_PLACES - num + 1),
            key=lambda begin: sum(begin <= place < begin + num for place in places),
        )
        others = iter({*range(first, first + num)} - places)
        for cache in caches:
            if not first <= cache.place < first + num:
                self._swap(cache.place, next(others))
        return first

    def _swap(self, one: int, other: int) -> None:
        self.rings[:, [one, other]] = self.rings[:, [other, one]]
        self._caches[one], self._caches[other] = self._caches[other], self._caches[one]
        for place in (one, other):
            if (reference := self._caches[place]) is None:
                self._give_back(place)
            elif (cache := reference()) is not None:
                cache.place = place

    def _on_gone(self, gone: weakref.ref[Cache]) -> None:
        place = self._caches.index(gone)
        self._caches[place] = None
        self._give_back(place)

    def _give_back(self, place: int) -> None:
        """Give back the memory of a place, but for pages that its neighbours share."""
        num_bytes, page = self.rings[0, place].nbytes, mmap.PAGESIZE
        for ring in range(len(self.rings)):
            begin = (ring * NUM_PLACES + place) * num_bytes
            first, end = -(-begin // page) * page, (begin + num_bytes) // page * page
            if first < end:
                self._memory.madvise(mmap.MADV_DONTNEED, first, end - first)
