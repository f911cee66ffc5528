"""Adjacent caches of sessions: each session keeps its values in any run."""

from __future__ import annotations

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.caches import NUM_PLACES, Cache, CacheMemory, CacheSizes
from kouxing.shared.metrics import memory_mb

pytestmark = pytest.mark.unit

SIZES = CacheSizes(rings=4, heads=2, slots=64, head_size=64)  # a ring: 16 kB
LARGE = CacheSizes(rings=4, heads=8, slots=128, head_size=128)  # 1 MiB


def marked(memory: CacheMemory, number: int) -> list[Cache]:
    """Open caches and fill each with its number, from 1."""
    caches = [memory.open() for _ in range(number)]
    for mark, cache in enumerate(caches, start=1):
        cache.rings[:] = mark
    return caches


def test_sessions_keep_their_caches_in_any_run() -> None:
    rng = np.random.default_rng(0)
    memory = CacheMemory(SIZES, NUM_PLACES)
    caches = marked(memory, NUM_PLACES)
    del caches[::5]  # leaves free places between them
    marks = [int(cache.rings.flat[0]) for cache in caches]
    for _ in range(100):
        chosen = rng.permutation(len(caches))[: rng.integers(1, len(caches) + 1)]
        ((numbers, rings),) = memory.runs([caches[number] for number in chosen])
        assert sorted(numbers) == [*range(len(chosen))]
        assert rings.shape == (4, len(chosen), 2, 64, 64)
        for row, number in enumerate(numbers):
            assert (rings[:, row] == marks[chosen[number]]).all()
        assert all((c.rings == mark).all() for c, mark in zip(caches, marks, strict=True))


def test_a_run_writes_to_the_caches() -> None:
    memory = CacheMemory(SIZES, NUM_PLACES)
    caches = marked(memory, 5)
    ((numbers, rings),) = memory.runs([caches[4], caches[0]])
    rings[:, numbers.index(0)] = 40
    rings[:, numbers.index(1)] = 10
    assert [int(cache.rings.flat[0]) for cache in caches] == [10, 2, 3, 4, 40]


def test_splits_many_sessions_into_runs() -> None:
    memory = CacheMemory(SIZES, NUM_PLACES)
    caches = marked(memory, 2 * NUM_PLACES + 1)
    runs = list(memory.runs(caches))
    assert [len(numbers) for numbers, _ in runs] == [NUM_PLACES, NUM_PLACES, 1]
    for numbers, rings in runs:
        assert [int(mark) for mark in rings[0, :, 0, 0, 0]] == [number + 1 for number in numbers]


def test_uses_memory_only_for_written_caches() -> None:
    memory = CacheMemory(LARGE, NUM_PLACES)
    first = memory.open()
    before_mb = memory_mb()
    caches = marked(memory, 8)
    assert 7.5 < memory_mb() - before_mb < 9.5
    list(memory.runs([first, caches[7]]))
    del caches[:7]
    assert memory_mb() - before_mb < 5.0
