"""Process items in parallel, on all cores of a machine with more than one."""

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any, TypeVar

_MIN_CORES = 2  # with one, a process would only compete with the caller
_AHEAD_PER_CORE = 6  # items that may wait for the caller

T = TypeVar("T")
R = TypeVar("R")

_function: Callable[[Any], Any]  # the function that a worker process runs


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def process_in_order(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Yield the function's result for each item, in order.

    Processes are forked when the iteration starts, so the function may use large data in memory.
    They are killed if the iteration ends early, for example by Ctrl-C.
    """
    num_processes = num_cores()
    if num_processes < _MIN_CORES:
        yield from map(function, items)
        return
    results: deque[Future[R]] = deque()
    others = multiprocessing.active_children()
    context = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(num_processes, context, _start_worker, (function,))
    try:
        for item in items:
            results.append(pool.submit(_process, item))
            if len(results) > _AHEAD_PER_CORE * num_processes:
                yield results.popleft().result()
        while results:
            yield results.popleft().result()
    except BaseException:
        for process in {*multiprocessing.active_children()} - {*others}:
            process.kill()  # the pool's own kill_workers() needs Python 3.14
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(function: Callable[[Any], Any]) -> None:
    global _function  # noqa: PLW0603
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C prints no traceback
    _function = function


def _process(item: Any) -> Any:
    return _function(item)
