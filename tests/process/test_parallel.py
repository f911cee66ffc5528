"""Work in several processes."""

import multiprocessing
import os

import numpy as np
import pytest

from kouxing.corpora import parallel
from kouxing.corpora.parallel import num_cores, process_in_order
from tests.system import LIMIT_S, start_python

# Ctrl-C reaches all processes, or only the first, while one of them works on an endless item.
INTERRUPT_PROCESSES = """
import os, signal, sys
from kouxing.corpora import parallel
from kouxing.services.cli import main
from kouxing.shared.interrupt import install_interrupt_handler
os.setsid()
parallel._MIN_CORES = 1
send, to = (os.killpg, os.getpgrp()) if sys.argv[1] == "all" else (os.kill, os.getpid())

def work(item):
    if item == 5:
        send(to, signal.SIGINT)
    while item > 5:
        signal.pause()

install_interrupt_handler()
main._run_command = lambda: list(parallel.process_in_order(work, range(100)))
main.main()
"""


@pytest.mark.parametrize("num_available", [1, 2])
def test_results_have_the_order_of_the_items(
    monkeypatch: pytest.MonkeyPatch, num_available: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: range(num_available))
    table = np.arange(1000)  # the processes share it
    results = process_in_order(lambda item: (int(table[item]), os.getpid()), range(200))
    numbers, processes = zip(*results, strict=True)
    assert numbers == tuple(range(200))
    assert (set(processes) == {os.getpid()}) == (num_available == 1)


def test_a_system_without_affinity_uses_all_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity")
    assert num_cores() == os.cpu_count()


def test_an_error_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "_MIN_CORES", 1)
    results = process_in_order(lambda item: 1 // (3 - item), range(100))
    assert [next(results) for _ in range(3)] == [0, 0, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_an_error_ends_no_other_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "_MIN_CORES", 1)
    here, there = multiprocessing.Pipe()
    other = multiprocessing.get_context("fork").Process(target=there.recv)
    other.start()
    with pytest.raises(ZeroDivisionError):
        list(process_in_order(lambda item: 1 // item, range(3)))
    here.send("end")
    other.join(LIMIT_S)
    assert other.exitcode == 0


@pytest.mark.parametrize("receivers", ["all", "first"])
def test_ctrl_c_ends_all_processes_without_a_traceback(receivers: str) -> None:
    process = start_python("-c", INTERRUPT_PROCESSES, receivers)
    assert process.communicate(timeout=LIMIT_S) == ("", "")  # no process holds the pipes open
    assert process.returncode == 130
