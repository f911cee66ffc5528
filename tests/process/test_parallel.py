"""Work in several processes."""

import os

import numpy as np
import pytest

from kouxing.corpora import parallel
from kouxing.corpora.parallel import process_in_order


@pytest.mark.parametrize("num_cores", [1, 4])
def test_results_have_the_order_of_the_items(
    monkeypatch: pytest.MonkeyPatch, num_cores: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: range(num_cores))
    table = np.arange(1000)  # the processes share it
    results = process_in_order(lambda item: (int(table[item]), os.getpid()), range(200))
    numbers, processes = zip(*results, strict=True)
    assert numbers == tuple(range(200))
    assert (set(processes) == {os.getpid()}) == (num_cores == 1)


def test_an_error_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "_MIN_CORES", 1)
    results = process_in_order(lambda item: 1 // (3 - item), range(100))
    assert [next(results) for _ in range(3)] == [0, 0, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)
