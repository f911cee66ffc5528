"""Measures what faults do to a live face: killed and frozen services, load, networks.

For each fault the services run as under ``kouxing run``, on free ports, or on virtual hosts
(``network.py``). A sentence is streamed in real time until something breaks. The results of a
subscriber are compared with those without a fault (``continuity.py``). A sudden fault happens at
several instants, in one session each. The worst value of each figure counts.
"""

import contextlib
import functools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from kouxing_client import Client, KouxingError, Refused, Session
from rich.console import Console

from kouxing.evaluation.system.continuity import Continuity, compare, worst
from kouxing.evaluation.system.live import ReceivedResults, speak, speak_undisturbed
from kouxing.evaluation.system.network import Network, NetworkLink
from kouxing.evaluation.system.systems import ON_HOSTS, SPARE, HostsSystem, LocalSystem, System
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.shared.arrays import Floats
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import create_folder
from kouxing.shared.settings.keys import CLIENT

NUM_SESSIONS = 16
SPIN = """
import signal, time
def spin(*_):
    end_s = time.monotonic() + {seconds}
    while time.monotonic() < end_s:
        pass
signal.signal(signal.SIGUSR1, spin)
"""  # runs in a service: its loop hangs, its other threads continue


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Durations of a session and its fault, seconds."""

    length_s: float = 24.0  # duration of the audio
    fault_at_s: float = 8.0
    other_times_s: tuple[float, ...] = (3.2, 4.6)  # in other sessions
    frozen_s: float = 10.0  # how long a service or the machine is blocked
    cut_s: float = 2.0  # how long a host is cut off


TIMING = Timing()

Action = tuple[float, Callable[[], object]]  # seconds after the first sample, function
Actions = Callable[[Any, str, Timing], list[Action]]


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault in a live session."""

    actions: Actions  # by system and session name
    spare: str = ""  # kind of which a second worker runs; then services do not restart
    num_sessions: int = 1
    link: NetworkLink | None = None  # between virtual hosts; None: everything runs on this host
    is_sudden: bool = True  # the effect depends on the instant


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultOutcome:
    """Effects of a fault."""

    fault: str
    failure: str  # reason why the session did not complete; empty if it did
    face: Continuity | None = None  # None: no frame arrived
    num_refused: int = 0  # sessions
    late_p95_ms: float | None = None  # maximum over all sessions
    load: float  # load average of the last minute


def _signal_service(service: str, number: int) -> Actions:
    """Return a fault that signals the process that serves the session."""

    def actions(system: System, session: str, timing: Timing) -> list[Action]:
        send = functools.partial(_send_signal, system.process_of(session, service))
        fault: Action = timing.fault_at_s, functools.partial(send, number)
        until_s = timing.fault_at_s + timing.frozen_s
        end: Action = until_s, functools.partial(send, signal.SIGCONT)
        return [fault, end] if number == signal.SIGSTOP else [fault]

    return actions


def _send_signal(process_id: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):  # the supervisor has ended it
        os.kill(process_id, number)


def _load_processor(_system: System, _session: str, timing: Timing) -> list[Action]:
    """Run four busy processes per core."""
    busy: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        for _ in range(4 * (os.cpu_count() or 1)):
            command = [sys.executable, "-c", f"import time\nwhile time.monotonic() < {end_s}: pass"]
            busy.append(subprocess.Popen(command, start_new_session=True))  # noqa: S603

    def stop() -> None:
        for process in busy:
            process.wait()

    stop_at_s = timing.fault_at_s + timing.frozen_s
    end_s = time.monotonic() + stop_at_s
    return [(timing.fault_at_s, start), (stop_at_s, stop)]


def _no_actions(_system: System, _session: str, _timing: Timing) -> list[Action]:
    return []


def _cut_link(end: str, *, is_mended: bool) -> Actions:
    """Return a fault that cuts off a host, for some time or permanently.

    ``end`` is the client's host, or the kind of the service that serves the session.
    """

    def actions(system: HostsSystem, session: str, timing: Timing) -> list[Action]:
        host = end if end == CLIENT else system.instance_of(session, end)
        cut: Action = timing.fault_at_s, functools.partial(system.network.cut, host)
        restore: Action = timing.fault_at_s + timing.cut_s, system.network.restore
        return [cut, restore] if is_mended else [cut]

    return actions


_WORKERS = ("recognizer", "synthesizer")
_SIGNALS = {"killed": signal.SIGKILL, "stopped": signal.SIGSTOP, "hangs": signal.SIGUSR1}
# fault of a worker, and whether there is a spare worker
_WORKER_FAULTS = (
    ("killed", False),
    ("killed", True),
    ("stopped", True),
    ("hangs", True),
    ("stopped", False),
    ("hangs", False),
)
FAULTS = {
    "none": Fault(_no_actions, is_sudden=False),
    **{
        f"{worker} {event}" + (", one more" if is_spared else ""): Fault(
            _signal_service(worker, _SIGNALS[event]), worker if is_spared else ""
        )
        for event, is_spared in _WORKER_FAULTS
        for worker in _WORKERS
    },
    "control killed": Fault(_signal_service("control", signal.SIGKILL)),
    "busy machine": Fault(_load_processor, is_sudden=False),
    f"{NUM_SESSIONS} sessions": Fault(_no_actions, num_sessions=NUM_SESSIONS, is_sudden=False),
    **{
        f"hosts, {delay_ms} ms, {loss:.0%} lost": Fault(
            _no_actions, link=NetworkLink(delay_ms, loss), is_sudden=False
        )
        for delay_ms in (0, 20, 50)
        for loss in (0.0, 0.01, 0.03)
    },
    "hosts, client cut off for 2 s": Fault(_cut_link(CLIENT, is_mended=True), link=NetworkLink()),
    **{
        f"hosts, {worker} gone for good, one more": Fault(
            _cut_link(worker, is_mended=False), worker, link=NetworkLink()
        )
        for worker in _WORKERS
    },
}


def measure(
    path: Path, names: Collection[str], logs: Path | None, console: Console, timing: Timing
) -> Iterator[FaultOutcome]:
    """Stream an audio file during faults, one after another; yield the effects of each.

    ``names`` are keys of ``FAULTS``; if empty, all run. ``logs`` gets a subfolder for each fault
    and instant. Raises ``UserError`` for an unknown fault, or if the file is not audio.
    """
    unknown = sorted(set(names) - set(FAULTS))
    if unknown:
        raise UserError(f"no fault is named {unknown[0]!r}; choose from {', '.join(FAULTS)}")
    sentence = to_16_khz(*read_audio(path))
    undisturbed: list[ReceivedResults] = []  # empty until it is measured
    for name in names or FAULTS:
        other_times_s = timing.other_times_s if FAULTS[name].is_sudden else ()
        outcomes = []
        for at_s in (*other_times_s, timing.fault_at_s):
            console.print(f"fault: {name}, at {at_s:g} s")
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary) if logs is None else logs / f"{name}-{at_s:g}-s"
                create_folder(folder)
                times = replace(timing, fault_at_s=at_s)
                try:
                    outcome = _measure_fault(name, folder, sentence, undisturbed, times, console)
                except UserError as error:
                    outcome = FaultOutcome(fault=name, failure=str(error), load=os.getloadavg()[0])
            outcomes.append(outcome)
        yield _worst_outcome(outcomes)


def _worst_outcome(outcomes: Sequence[FaultOutcome]) -> FaultOutcome:
    """Return the worst value of each figure."""
    faces = [outcome.face for outcome in outcomes if outcome.face is not None]
    late_ms = [outcome.late_p95_ms for outcome in outcomes if outcome.late_p95_ms is not None]
    numbers = ("num_refused", "load")
    return FaultOutcome(
        fault=outcomes[0].fault,
        failure="; ".join(sorted({outcome.failure for outcome in outcomes} - {""})),
        face=worst(faces) if faces else None,
        late_p95_ms=max(late_ms, default=None),
        **{name: max(getattr(outcome, name) for outcome in outcomes) for name in numbers},
    )


@contextlib.contextmanager
def _start_system(fault: Fault, folder: Path, timing: Timing, console: Console) -> Iterator[System]:
    if fault.link is None:
        (folder / "sitecustomize.py").write_text(
            SPIN.format(seconds=timing.frozen_s), encoding="utf-8"
        )
        paths = [str(folder.resolve()), os.environ.get("PYTHONPATH", "")]
        settings = {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
        with LocalSystem(folder, console, settings=settings, spare=fault.spare) as local:
            yield local
        return
    hosts = [*ON_HOSTS, CLIENT, *([SPARE] if fault.spare else [])]
    with (
        tempfile.TemporaryDirectory() as states,
        Network(hosts, fault.link) as network,
        HostsSystem(folder, Path(states), network, fault.spare) as system,
    ):
        yield system


def _measure_fault(
    name: str,
    folder: Path,
    sentence: Floats,
    undisturbed: list[ReceivedResults],
    timing: Timing,
    console: Console,
) -> FaultOutcome:
    fault = FAULTS[name]
    sound = np.resize(sentence, round(timing.length_s * MEDIA_RATE_HZ))
    with (
        _start_system(fault, folder, timing, console) as system,
        system.on_client(),
        connect_client(system.control, key=system.key) as client,
    ):
        if not undisturbed:
            undisturbed.append(speak_undisturbed(client, sound))
        sessions, num_refused = _open_all(client, fault.num_sessions)
        delay_s = sessions[0].info["facts"]["delay_ms"] / 1e3
        actions = fault.actions(system, sessions[0].name, timing)
        start_s = time.monotonic()

        def on_step() -> None:
            while actions and time.monotonic() > start_s + actions[0][0]:
                actions.pop(0)[1]()

        all_received = speak(sessions, sound, on_step=on_step)
        load = os.getloadavg()[0]
        for session in sessions:
            with contextlib.suppress(KouxingError):  # already closed
                session.close()
    failures = [
        received.error or "no last frame" for received in all_received if not received.ended
    ]
    fault_s = start_s + timing.fault_at_s
    faces = [
        compare(received, undisturbed[0], delay_s, fault_s=fault_s)
        for received in all_received
        if received.frames
    ]
    return FaultOutcome(
        fault=name,
        failure=", ".join(sorted(set(failures))),
        face=faces[0] if faces else None,
        num_refused=num_refused,
        late_p95_ms=max((face.late_p95_ms for face in faces), default=None),
        load=load,
    )


def _open_all(client: Client, num: int) -> tuple[list[Session], int]:
    """Open sessions; return them and the number of rejected ones. The first is never one."""
    sessions = [client.open_session(encoding="f32le")]
    num_refused = 0
    for _ in range(num - 1):
        try:
            sessions.append(client.open_session(encoding="f32le"))
        except Refused:
            num_refused += 1
    return sessions, num_refused
