"""Attention caches: a network's keys and values of the earlier positions of each session.

A network takes the caches of all sessions in a run as one array. To avoid copies, caches are
adjacent in memory. Sessions that run together are swapped into adjacent places. They mostly stay
there, because audio arrives in the same order again.
"""

from __future__ import annotations

import mmap
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NUM_PLACES = 16  # for caches in a block of memory

Float16 = NDArray[np.float16]


@dataclass(frozen=True, slots=True)
class CacheSizes:
    """Sizes of a session's cache."""

    rings: int  # keys of all layers, then values
    heads: int
    slots: int  # positions in a ring
    head_size: int

    @property
    def num_bytes(self) -> int:
        """Memory of a cache, with 16-bit numbers."""
        return 2 * self.rings * self.heads * self.slots * self.head_size


def cache_names(num_layers: int) -> list[str]:
    """Return the names of a network's cache inputs, in the order of the rings."""
    return [f"{kind}_{layer}" for kind in ("keys", "values") for layer in range(num_layers)]


class Cache:
    """Keys and values of a session. Its place becomes free with the last reference to it.

    Positions that were not written yet may hold another session's values and must be masked.
    """

    __slots__ = ("__weakref__", "place", "pool")

    def __init__(self, pool: CachePool, place: int) -> None:
        self.pool = pool
        self.place = place

    @property
    def rings(self) -> Float16:
        """Keys and values, (rings, heads, slots, size), to read and write."""
        return self.pool.rings[:, self.place]


class CacheMemory:
    """The caches of all sessions. A run of the network has up to ``max_batch`` sessions."""

    def __init__(self, sizes: CacheSizes, max_batch: int) -> None:
        self._sizes = sizes
        self._max_batch = max_batch
        self._pools: list[weakref.ref[CachePool]] = []

    def open(self) -> Cache:
        """Return a cache for a new session."""
        pools = [pool for reference in self._pools if (pool := reference()) is not None]
        pool = next((pool for pool in pools if None in pool.caches), None)
        if pool is None:
            pool = CachePool(self._sizes)
            pools.append(pool)
        self._pools = [weakref.ref(pool) for pool in pools]
        return pool.open()

    def runs(self, caches: Sequence[Cache]) -> Iterator[tuple[list[int], Float16]]:
        """Yield runs for sessions with these caches, until all sessions are covered.

        A run has the indices of its sessions, in the order of their rows, and their keys and
        values, (rings, sessions, heads, slots, size), valid until the next run.
        """
        numbers: dict[CachePool, list[int]] = {}
        for number, cache in enumerate(caches):
            numbers.setdefault(cache.pool, []).append(number)
        for pool, members in numbers.items():
            first = pool.gather([caches[number] for number in members])
            members.sort(key=lambda number: caches[number].place)
            for begin in range(0, len(members), self._max_batch):
                batch = members[begin : begin + self._max_batch]
                place = first + begin
                yield batch, pool.rings[:, place : place + len(batch)]


class CachePool:
    """Adjacent places for caches; free places use no memory."""

    def __init__(self, sizes: CacheSizes) -> None:
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
        self._memory = mmap.mmap(-1, NUM_PLACES * sizes.num_bytes, flags=flags)
        shape = (sizes.rings, NUM_PLACES, sizes.heads, sizes.slots, sizes.head_size)
        self.rings: Float16 = np.frombuffer(self._memory, np.float16).reshape(shape)
        self.caches: list[weakref.ref[Cache] | None] = [None] * NUM_PLACES

    def open(self) -> Cache:
        """Return a cache in a free place."""
        cache = Cache(self, self.caches.index(None))
        self.caches[cache.place] = weakref.ref(cache, self._on_deleted)
        return cache

    def gather(self, caches: Sequence[Cache]) -> int:
        """Make caches adjacent; return the place of the first."""
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
        self.caches[one], self.caches[other] = self.caches[other], self.caches[one]
        for place in (one, other):
            if (reference := self.caches[place]) is None:
                self._free(place)
            elif (cache := reference()) is not None:
                cache.place = place

    def _on_deleted(self, deleted: weakref.ref[Cache]) -> None:
        place = self.caches.index(deleted)
        self.caches[place] = None
        self._free(place)

    def _free(self, place: int) -> None:
        """Return the memory of a place to the system, except for pages that it shares."""
        num_bytes, page = self.rings[0, place].nbytes, mmap.PAGESIZE
        for ring in range(len(self.rings)):
            begin = (ring * NUM_PLACES + place) * num_bytes
            first, end = -(-begin // page) * page, (begin + num_bytes) // page * page
            if first < end:
                self._memory.madvise(mmap.MADV_DONTNEED, first, end - first)
