"""Measures the lateness of a live face while other programs keep the processor busy.

One client streams speech in a loop. Busy programs run for a while. Each has its own process
session, like a desktop program, because Linux first divides the processor among these sessions. The
*lateness* of the face is the time since the audio of the newest frame was due, minus its median
before the load. The lateness therefore also grows while no frame arrives.
"""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kouxing_client import Client
from rich.console import Console

from kouxing.evaluation.system.load import SETTLE_S, LoadGenerator, Speaker
from kouxing.evaluation.system.systems import run_all_services
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.service_kinds import KINDS
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.clock import to_seconds
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.errors import UserError

LATE_S = 0.3  # lateness above which the face is behind
RECOVERED_S = 0.05  # maximum lateness of a face that has recovered
STEADY_S = 1.0  # time for which the lateness must stay at or below this maximum
QUIET_S = 5.0  # measured time before the load
AFTER_S = 15.0  # measured time after the load
FIRST_FRAME_LIMIT_S = 30.0
STEP_S = 0.02  # interval of the lateness values
_PROC = Path("/proc")


# ``cpu_cores`` of a service, and ``wake_ups`` of its threads per second
UsageRate = dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class BusyRun:
    """Lateness of the face with a number of busy programs."""

    num_programs: int
    quiet_median_s: float  # from the audio of a frame to its arrival, before the load
    lateness_s: list[float]  # every STEP_S from the start of the load
    load_s: float  # duration of the load
    missing: float  # fraction of the frames that never arrived

    @property
    def worst_s(self) -> float:
        """The largest lateness."""
        return max(self.lateness_s)

    @property
    def longest_s(self) -> float:
        """Duration of the longest time in which the face was behind."""
        longest = current = 0
        for late_s in self.lateness_s:
            current = current + 1 if late_s > LATE_S else 0
            longest = max(longest, current)
        return longest * STEP_S

    @property
    def recovery_s(self) -> float | None:
        """Time from the end of the load until the face has recovered; None if it does not."""
        num_steady = round(STEADY_S / STEP_S)
        after = self.lateness_s[round(self.load_s / STEP_S) :]
        for start in range(len(after) - num_steady + 1):
            if max(after[start : start + num_steady]) <= RECOVERED_S:
                return start * STEP_S
        return None

    @property
    def summary(self) -> dict[str, float | None]:
        """The figures of the run."""
        names = ("worst_s", "longest_s", "recovery_s", "missing")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, slots=True, kw_only=True)
class BusyResults:
    """All figures."""

    runs: list[BusyRun]
    idle: dict[str, UsageRate]  # by service, in silence
    speaking: dict[str, UsageRate]  # by service, before the load
    machine_load: float  # load average of the minute before


def measure(
    paths: Sequence[Path],
    programs: Sequence[int],
    load_s: float,
    console: Console,
    language: str | None = None,
) -> BusyResults:
    """Start all services, and speak while each number of busy programs runs.

    ``language`` is the language of the speech. If None, it is the recognizer's. Raises
    ``UserError`` if a file is not audio, or the services cannot start.
    """
    speech = np.concatenate([to_16_khz(*read_audio(path)) for path in paths])
    machine_load = os.getloadavg()[0]
    runs: list[BusyRun] = []
    with run_all_services(console) as system, connect_client(system.control) as client:
        processes = {name: system.supervisor.process(name).pid for name in KINDS}
        time.sleep(SETTLE_S)
        idle = _measure_usage(processes, lambda: time.sleep(QUIET_S))
        with _speaker(client, speech, language) as (generator, quiet_s):
            speaking = _measure_usage(processes, lambda: generator.speak_until(quiet_s + QUIET_S))
        for num in programs:
            console.print(f"speaking with {num} busy programs")
            runs.append(_run(client, speech, num, load_s, language))
    return BusyResults(runs=runs, idle=idle, speaking=speaking, machine_load=machine_load)


@contextlib.contextmanager
def _speaker(
    client: Client, speech: Floats, language: str | None
) -> Iterator[tuple[LoadGenerator, float]]:
    """Open a session, speak until frames arrive; yield the speaker and the time reached."""
    generator = LoadGenerator(client, speech, 1, language)
    if not generator.speakers:
        raise UserError(f"control rejects the session: {', '.join(generator.refusals)}")
    generator.start()
    (speaker,) = generator.speakers
    quiet_s = time.perf_counter()
    limit_s = quiet_s + FIRST_FRAME_LIMIT_S
    while not speaker.arrived_s:
        if quiet_s > limit_s:
            raise UserError("no frames arrived; close other programs and try again")
        quiet_s += SETTLE_S
        generator.speak_until(quiet_s)
    yield generator, quiet_s
    generator.close()


def _run(
    client: Client, speech: Floats, num_programs: int, load_s: float, language: str | None
) -> BusyRun:
    with _speaker(client, speech, language) as (generator, quiet_s):
        start_s = quiet_s + QUIET_S
        generator.speak_until(start_s)
        with _busy_programs(num_programs):
            generator.speak_until(start_s + load_s)
        end_s = start_s + load_s + AFTER_S
        generator.speak_until(end_s)
        (speaker,) = generator.speakers
        frames = _frames(speaker)
        num_due = round((end_s - start_s) * speaker.session.info["facts"]["frame_rate_hz"])
    median_s = float(np.median(_ages_s(frames, quiet_s, start_s)))
    num_shown = sum(start_s <= due_s < end_s for due_s, _ in frames)
    return BusyRun(
        num_programs=num_programs,
        quiet_median_s=median_s,
        lateness_s=[float(age_s) for age_s in _ages_s(frames, start_s, end_s) - median_s],
        load_s=load_s,
        missing=max(0.0, 1.0 - num_shown / num_due),
    )


def _frames(speaker: Speaker) -> list[tuple[float, float]]:
    """Return, for each frame in order, when its audio was due and when the frame arrived."""
    arrived_s = speaker.arrived_s.copy()  # another thread adds frames
    return sorted(
        (speaker.start_s + to_seconds(media_time), at_s) for media_time, at_s in arrived_s.items()
    )


def _ages_s(frames: Sequence[tuple[float, float]], from_s: float, until_s: float) -> Doubles:
    """Return the time since the audio of the newest frame was due, every ``STEP_S``."""
    due_s, arrived_s = np.array(frames).T
    order = np.argsort(arrived_s)
    newest_s = np.maximum.accumulate(due_s[order])
    times_s = np.arange(from_s, until_s, STEP_S)
    known = np.searchsorted(arrived_s[order], times_s, side="right") - 1
    return times_s - newest_s[np.maximum(known, 0)]


@contextlib.contextmanager
def _busy_programs(num: int) -> Iterator[None]:
    programs = [
        subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"], start_new_session=True)
        for _ in range(num)
    ]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
        for program in programs:
            program.wait()


def _measure_usage(
    processes: Mapping[str, int], action: Callable[[], None]
) -> dict[str, UsageRate]:
    """Return the resources that each service uses while an action runs."""
    started_s = time.monotonic()
    before = {name: _read_usage(process) for name, process in processes.items()}
    action()
    passed_s = time.monotonic() - started_s
    after = {name: _read_usage(process) for name, process in processes.items()}
    return {
        name: {
            resource: (after[name][resource] - used) / passed_s
            for resource, used in before[name].items()
        }
        for name in processes
    }


def _read_usage(process_id: int) -> UsageRate:
    """Return the CPU seconds of a process and the number of wake-ups of its threads so far.

    Raises ``UserError`` if the system has no /proc, or the process has ended.
    """
    try:
        # The clock of clock_getcpuclockid(3); /proc counts only hundredths of a second.
        cpu_s = time.clock_gettime(~process_id << 3 | 2)
        states = [
            (thread / "status").read_text("utf-8")
            for thread in (_PROC / str(process_id) / "task").iterdir()
        ]
    except OSError as error:
        message = f"cannot read the processor time of a service: {error}; run this command on Linux"
        raise UserError(message) from None
    wake_ups = sum(
        int(line.split()[1])
        for state in states
        for line in state.splitlines()
        if line.startswith("voluntary_ctxt_switches")
    )
    return {"cpu_cores": cpu_s, "wake_ups": wake_ups}
