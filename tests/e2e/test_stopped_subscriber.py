"""Stopped for a while, a subscriber goes on with the newest frames of a live face, or with all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO

import numpy as np
import pytest
from kouxing_client import Client, FapFrame, Results, Session

from tests.e2e.following import samples_of_file
from tests.system import DEMO, System

pytestmark = pytest.mark.e2e
STOPPED_S = 5.0
MAX_OLD = 10  # frames
RATE_HZ = 50
FOLLOWER = """
import sys
from kouxing_client import Client, FapFrame

control, session, paced = sys.argv[1:]
with Client(control) as client:
    frames = client.follow(session, paced=paced == "True").results(FapFrame, keep_all=True)
    print(0, flush=True)
    for frame in frames:
        print(frame.sequence, flush=True)
"""


class Other:
    """A program that follows a session."""

    def __init__(self, process: subprocess.Popen[str], out: IO[str]) -> None:
        self.process = process
        self.numbers: list[int] = []  # of the frames that came
        self._out = out

    def read(self) -> None:
        self.numbers += map(int, self._out)


@contextmanager
def another(control: str, session: Session, *, paced: bool) -> Iterator[Other]:
    command = [sys.executable, "-c", FOLLOWER, control, session.name, str(paced)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        other = Other(process, process.stdout)
        reader = threading.Thread(target=other.read)
        reader.start()
        try:
            until(lambda: bool(other.numbers), "it does not follow")
            yield other
        finally:
            process.kill()
            reader.join()


def newest_of(output: Results[FapFrame]) -> int:
    """Return the number of the newest frame that has come."""
    number = 0
    for frame in output.available():
        number = frame.sequence
    return number


def until(is_so: Callable[[], bool], otherwise: str) -> None:
    end_s = time.monotonic() + 60.0
    while not is_so():
        assert time.monotonic() < end_s, otherwise
        time.sleep(0.02)


def test_of_a_live_face_few_old_frames_come(system: System) -> None:
    with Client(system.control) as client:
        session = client.open_session(encoding="f32le")
        output = session.results(FapFrame, keep_all=True)
        session.push(np.zeros(320, np.float32))  # then frames of rest go on and on
        with another(system.control, session, paced=True) as other:
            until(lambda: len(other.numbers) > RATE_HZ, "no frames come")
            os.kill(other.process.pid, signal.SIGSTOP)
            time.sleep(STOPPED_S)
            stopped_at, went_on_at = other.numbers[-1], newest_of(output)
            os.kill(other.process.pid, signal.SIGCONT)
            until(lambda: other.numbers[-1] > went_on_at + RATE_HZ, "it does not go on")
            old = [n for n in other.numbers if stopped_at < n < went_on_at - RATE_HZ]
        session.close()
    assert went_on_at - stopped_at > 3 * RATE_HZ
    assert len(old) <= MAX_OLD
    assert other.numbers == sorted(set(other.numbers))


def test_of_a_recording_every_frame_comes(system: System) -> None:
    samples = np.tile(samples_of_file(DEMO / "hello-female.wav")[:48000], 4)
    with Client(system.control) as client:
        session = client.open_session(encoding="f32le", paced=False)
        with another(system.control, session, paced=False) as other:
            os.kill(other.process.pid, signal.SIGSTOP)
            for chunk in np.split(samples, len(samples) // 3200):
                session.push(chunk)
            session.finish()
            time.sleep(STOPPED_S)
            os.kill(other.process.pid, signal.SIGCONT)
            until(lambda: other.process.poll() is not None, "the end does not come")
        session.close()
    assert other.numbers == list(range(len(other.numbers)))
    assert len(other.numbers) > len(samples) // 320
