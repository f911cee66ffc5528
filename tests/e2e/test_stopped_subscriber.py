"""A subscriber that was stopped continues with the newest frames, or with all of a recording."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from kouxing_client import Client, FapFrame, Session

from tests.e2e.following import samples_of_file
from tests.system import DEMO, System, start_python, wait_until

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


@contextmanager
def following(
    control: str, session: Session, *, paced: bool
) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """Run a program that follows a session; yield it and the numbers of its frames."""
    numbers: list[int] = []
    process = start_python("-c", FOLLOWER, control, session.name, paced)
    assert process.stdout is not None
    reader = threading.Thread(
        target=lambda out: numbers.extend(map(int, out)), args=[process.stdout]
    )
    reader.start()
    try:
        wait_until(lambda: numbers)
        yield process, numbers
    finally:
        process.kill()
        reader.join()
        process.communicate()


def test_a_live_face_continues_with_few_old_frames(system: System) -> None:
    with Client(system.control) as client, client.open_session(encoding="f32le") as session:
        output = session.results(FapFrame, keep_all=True)
        newest = 0

        def has_reached(number: int) -> bool:
            nonlocal newest
            newest = max([newest, *(frame.sequence for frame in output.available(0.1))])
            return bool(newest > number)

        session.push(np.zeros(320, np.float32))  # frames of rest continue after it
        with following(system.control, session, paced=True) as (process, numbers):
            wait_until(lambda: len(numbers) > RATE_HZ)
            process.send_signal(signal.SIGSTOP)
            stopped_at = numbers[-1]
            wait_until(lambda: has_reached(stopped_at + 5 * RATE_HZ))
            continued_at = newest
            process.send_signal(signal.SIGCONT)
            wait_until(lambda: numbers[-1] > continued_at + RATE_HZ)
    old = [number for number in numbers if stopped_at < number < continued_at - RATE_HZ]
    assert len(old) <= MAX_OLD
    assert numbers == sorted({*numbers})


def test_of_a_recording_every_frame_arrives(system: System) -> None:
    samples = np.tile(samples_of_file(DEMO / "hello-female.wav")[:48000], 2)
    with (
        Client(system.control) as client,
        client.open_session(encoding="f32le", paced=False) as session,
    ):
        mine = session.results(FapFrame, keep_all=True)
        with following(system.control, session, paced=False) as (process, numbers):
            process.send_signal(signal.SIGSTOP)
            for chunk in np.split(samples, len(samples) // 3200):
                session.push(chunk)
            session.finish()
            wait_until(lambda: list(mine.available(0.1)) is not None and mine.has_ended)
            process.send_signal(signal.SIGCONT)
            wait_until(lambda: process.poll() is not None)
    assert numbers == [*range(len(numbers))]
    assert len(numbers) > len(samples) // 320
