"""What faults do to a live face: services killed and frozen, load, slow subscribers, networks.

For each fault the services run as under ``kouxing run``, on ports of their own, or each on a host
of its own (``evaluation.system.network``). A sentence is streamed again and again at real pace, in
the midst of it something breaks, and what a subscriber saw is compared with the same sound
undisturbed (``evaluation.system.continuity``). What is sudden happens at several instants, in a
session each; the worst of each figure counts.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from kouxing_client import Client, KouxingError, Refused, Session
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.system.continuity import Continuity, compare, staleness, worst
from kouxing.evaluation.system.live import Seen, Wire, speak, speak_undisturbed
from kouxing.evaluation.system.network import Link, Network
from kouxing.evaluation.system.systems import ON_HOSTS, SPARE, HostsSystem, LocalSystem, System
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.audio_file import read_audio
from kouxing.shared.clock import MEDIA_RATE_HZ, to_samples
from kouxing.shared.config import COMMON, variable
from kouxing.shared.control_client import connect
from kouxing.shared.errors import UserError
from kouxing.shared.keys import CLIENT
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory

NUM_SESSIONS = 16
SPIN = """
import signal, time
def spin(*_):
    end_s = time.monotonic() + {seconds}
    while time.monotonic() < end_s:
        pass
signal.signal(signal.SIGUSR1, spin)
"""  # in a service: its loop hangs, its other threads do not


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """How long a session and its fault take, in seconds."""

    length_s: float = 24.0  # of the sound
    fault_at_s: float = 8.0
    also_at_s: tuple[float, ...] = (3.2, 4.6)  # in sessions of their own
    frozen_s: float = 10.0  # a service, or others busy
    stopped_s: float = 60.0  # a subscriber, for which the sound is longer
    cut_s: float = 2.0  # a link


TIMING = Timing()

Action = tuple[float, Callable[[], object]]  # seconds after the first sample, what is done then


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that breaks in a live session."""

    actions: Callable[[Any, str, Timing], list[Action]]  # of a system, in a session of some name
    beside: str = ""  # service of which a second one runs; then nothing is started again
    num_sessions: int = 1
    stops_subscriber: bool = False  # a second one
    link: Link | None = None  # between hosts of their own; None: all is on this one
    is_sudden: bool = True  # what it does depends on the instant


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What a fault did."""

    fault: str
    failure: str  # why it could not be measured to its end; empty: it could
    face: Continuity | None = None  # None: no frame came
    old_frames: int = 0  # published in an earlier epoch after the first of a later one
    num_refused: int = 0  # of several sessions
    late_p95_ms: float | None = None  # the most of all sessions
    stale_frames: int = 0  # of more than a second, that a subscriber got after it was stopped
    stalest_s: float = 0.0
    load: float  # average of this machine's processes that run, over a minute


def _kill(service: str) -> Callable[[System, str, Timing], list[Action]]:
    """Return a fault: the process that serves the session ends."""

    def actions(system: System, session: str, timing: Timing) -> list[Action]:
        return [_signal(system.process_of(session, service), signal.SIGKILL, timing.fault_at_s)]

    return actions


def _stop(service: str) -> Callable[[System, str, Timing], list[Action]]:
    """Return a fault: the process that serves the session is stopped for some time."""

    def actions(system: System, session: str, timing: Timing) -> list[Action]:
        number = system.process_of(session, service)
        return _stopped(number, timing.fault_at_s, timing.frozen_s)

    return actions


def _hang(service: str) -> Callable[[System, str, Timing], list[Action]]:
    """Return a fault: the loop of the process that serves the session hangs for some time."""

    def actions(system: System, session: str, timing: Timing) -> list[Action]:
        return [_signal(system.process_of(session, service), signal.SIGUSR1, timing.fault_at_s)]

    return actions


def _signal(number: int, which: int, at_s: float) -> Action:
    def send() -> None:
        with contextlib.suppress(ProcessLookupError):  # it was ended meanwhile
            os.kill(number, which)

    return at_s, send


def _stopped(number: int, at_s: float, for_s: float) -> list[Action]:
    return [
        _signal(number, signal.SIGSTOP, at_s),
        _signal(number, signal.SIGCONT, at_s + for_s),
    ]


def _busy(_system: System, _session: str, timing: Timing) -> list[Action]:
    """Return a fault: four processes a core do nothing but spin."""
    spinning: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        for _ in range(4 * (os.cpu_count() or 1)):
            command = [sys.executable, "-c", f"import time\nwhile time.monotonic() < {end_s}: pass"]
            spinning.append(subprocess.Popen(command, start_new_session=True))  # noqa: S603

    def stop() -> None:
        for process in spinning:
            process.wait()

    stop_at_s = timing.fault_at_s + timing.frozen_s
    end_s = time.monotonic() + stop_at_s
    return [(timing.fault_at_s, start), (stop_at_s, stop)]


def _nothing(_system: System, _session: str, _timing: Timing) -> list[Action]:
    return []


def _cut(which: str, *, mended: bool) -> Callable[[HostsSystem, str, Timing], list[Action]]:
    """Return a fault: a host is cut off, for some time or else for good.

    ``which`` is the client's host, or the kind of service that serves the session there.
    """

    def actions(system: HostsSystem, session: str, timing: Timing) -> list[Action]:
        host = which if which == CLIENT else system.host_of(session, which)
        cut: Action = timing.fault_at_s, functools.partial(system.network.cut, host)
        mend: Action = timing.fault_at_s + timing.cut_s, system.network.mend
        return [cut, mend] if mended else [cut]

    return actions


_WORKERS = ("recognizer", "synthesizer")
FAULTS = {
    "none": Fault(_nothing, is_sudden=False),
    **{f"{each} killed": Fault(_kill(each)) for each in _WORKERS},
    **{f"{each} killed, one more": Fault(_kill(each), each) for each in _WORKERS},
    **{f"{each} stopped, one more": Fault(_stop(each), each) for each in _WORKERS},
    **{f"{each} hangs, one more": Fault(_hang(each), each) for each in _WORKERS},
    **{f"{each} stopped": Fault(_stop(each)) for each in _WORKERS},
    **{f"{each} hangs": Fault(_hang(each)) for each in _WORKERS},
    "control killed": Fault(_kill("control")),
    "busy machine": Fault(_busy, is_sudden=False),
    f"{NUM_SESSIONS} sessions": Fault(_nothing, num_sessions=NUM_SESSIONS, is_sudden=False),
    "a subscriber stopped": Fault(_nothing, stops_subscriber=True, is_sudden=False),
    **{
        f"hosts, {delay_ms} ms, {loss:.0%} lost": Fault(
            _nothing, link=Link(delay_ms, loss), is_sudden=False
        )
        for delay_ms in (0, 20, 50)
        for loss in (0.0, 0.01, 0.03)
    },
    "hosts, client cut off for 2 s": Fault(_cut(CLIENT, mended=True), link=Link()),
    **{
        f"hosts, {each} gone for good, one more": Fault(_cut(each, mended=False), each, link=Link())
        for each in _WORKERS
    },
}


def measure(
    path: Path,
    names: Collection[str],
    logs: Path | None,
    console: Console,
    timing: Timing,
) -> Iterator[Outcome]:
    """Let faults happen, one after another; yield what each did.

    Parameters
    ----------
    names
        Of ``FAULTS``; empty: all.
    logs
        Folder for the services' logs, one in it for each fault and instant; None: none are kept.

    Raises
    ------
    UserError
        If there is no such fault, or the file is no audio.
    """
    unknown = sorted(set(names) - set(FAULTS))
    if unknown:
        raise UserError(f"{unknown[0]!r} is no fault; there are {', '.join(FAULTS)}")
    sentence = to_16_khz(*read_audio(path))
    undisturbed: dict[int, Seen] = {}  # by the length of the sound
    for name in names or FAULTS:
        also_at_s = timing.also_at_s if FAULTS[name].is_sudden else ()
        outcomes = []
        for at_s in (*also_at_s, timing.fault_at_s):
            console.print(f"fault: {name}, at {at_s:g} s")
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary) if logs is None else logs / f"{name}-{at_s:g}-s"
                folder.mkdir(parents=True, exist_ok=True)
                own = replace(timing, fault_at_s=at_s)
                try:
                    outcome = _outcome(name, folder, sentence, undisturbed, own, console)
                except UserError as error:
                    outcome = Outcome(fault=name, failure=str(error), load=os.getloadavg()[0])
            outcomes.append(outcome)
        yield _worst(outcomes)


def _worst(outcomes: Sequence[Outcome]) -> Outcome:
    """Return the worst of each figure of one fault's outcomes."""
    faces = [each.face for each in outcomes if each.face is not None]
    late_ms = [each.late_p95_ms for each in outcomes if each.late_p95_ms is not None]
    return Outcome(
        fault=outcomes[0].fault,
        failure="; ".join(sorted({each.failure for each in outcomes} - {""})),
        face=worst(faces) if faces else None,
        old_frames=max(each.old_frames for each in outcomes),
        num_refused=max(each.num_refused for each in outcomes),
        late_p95_ms=max(late_ms, default=None),
        stale_frames=max(each.stale_frames for each in outcomes),
        stalest_s=max(each.stalest_s for each in outcomes),
        load=max(each.load for each in outcomes),
    )


def show(outcomes: Collection[Outcome], console: Console) -> None:
    """Print the figures as a table, and which sessions did not come to their end."""
    table = Table(
        "fault",
        "stood s",
        "late s",
        "phones lost, doubled, changed",
        "frames lost, doubled, old, at rest",
        "largest step",
        "p50, p95 ms",
        "load",
    )
    for each in outcomes:
        face = each.face
        notes = [f"not completed: {each.failure}"] if each.failure else []
        if each.num_refused:
            notes.append(f"{each.num_refused} refused")
        if each.stale_frames:
            notes.append(f"{each.stale_frames} stale frames, of up to {each.stalest_s:.1f} s")
        figures = ["no frame"]
        if face is not None:
            phones = face.phones_lost, face.phones_doubled, face.phones_changed
            frames = face.frames_lost, face.frames_doubled, each.old_frames, face.rest_frames
            figures = [
                f"{face.stood_s:.2f}",
                f"{face.late_s:.2f}",
                f"{', '.join(map(str, phones))} of {face.phones}",
                ", ".join(map(str, frames)),
                f"{face.largest_step:.1f} x {face.largest_step_fap}",
                f"{face.late_p50_ms:.0f}, {each.late_p95_ms:.0f}",
                f"{each.load:.1f}",
            ]
        table.add_row("; ".join([each.fault, *notes]), *figures)
    console.print(table)


@contextlib.contextmanager
def _system(fault: Fault, folder: Path, timing: Timing, console: Console) -> Iterator[System]:
    if fault.link is None:
        (folder / "sitecustomize.py").write_text(
            SPIN.format(seconds=timing.frozen_s), encoding="utf-8"
        )
        paths = [str(folder.resolve()), os.environ.get("PYTHONPATH", "")]
        settings = {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
        with LocalSystem(folder, console, settings=settings, beside=fault.beside) as local:
            yield local
        return
    hosts = [*ON_HOSTS, CLIENT, *([SPARE] if fault.beside else [])]
    with (
        tempfile.TemporaryDirectory() as states,
        Network(hosts, fault.link) as network,
        HostsSystem(folder, Path(states), network, fault.beside) as system,
    ):
        yield system


def _outcome(
    name: str,
    folder: Path,
    sentence: NDArray[np.float32],
    undisturbed: dict[int, Seen],
    timing: Timing,
    console: Console,
) -> Outcome:
    fault = FAULTS[name]
    stopped_s = timing.stopped_s if fault.stops_subscriber else 0.0
    length_s = timing.length_s + stopped_s
    sound = np.resize(sentence, round(length_s * MEDIA_RATE_HZ))
    delay_s = SynthesizerConfig().delay_ms / 1e3
    with (
        _system(fault, folder, timing, console) as system,
        system.on_client(),
        connect(system.control, key=system.key) as client,
    ):
        if len(sound) not in undisturbed:
            undisturbed[len(sound)] = speak_undisturbed(client, sound)
        sessions, num_refused = _open_all(client, fault.num_sessions)
        silence = load_inventory(sessions[0].info["facts"]["language"] or DEFAULT_LANGUAGE).silence
        publishers = [
            each.endpoints["faps"] for each in client.status().services if "faps" in each.endpoints
        ]
        wire = Wire(sessions[0], publishers, system.key)
        actions = fault.actions(system, sessions[0].name, timing)
        with _listener(system, sessions[0].name, stopped_s, timing, actions) as listened:
            begin_s = time.monotonic()

            def meanwhile() -> None:
                wire.take()
                while actions and time.monotonic() > begin_s + actions[0][0]:
                    actions.pop(0)[1]()

            all_seen = speak(sessions, sound, meanwhile=meanwhile)
        ages_s = staleness(listened, all_seen[0], begin_s + timing.fault_at_s + stopped_s)
        load = os.getloadavg()[0]
        wire.close()
        for session in sessions:
            with contextlib.suppress(KouxingError):  # gone already
                session.close()
    failures = [seen.error or "no last frame" for seen in all_seen if not seen.ended]
    faces = [
        compare(
            seen,
            undisturbed[len(sound)],
            silence,
            delay_s,
            fault_s=begin_s + timing.fault_at_s,
        )
        for seen in all_seen
        if seen.frames
    ]
    return Outcome(
        fault=name,
        failure=", ".join(sorted(set(failures))),
        face=faces[0] if faces else None,
        old_frames=wire.num_old,
        num_refused=num_refused,
        late_p95_ms=max((face.late_p95_ms for face in faces), default=None),
        stale_frames=int((ages_s > 1.0).sum()),
        stalest_s=float(ages_s.max(initial=0.0)),
        load=load,
    )


@contextlib.contextmanager
def _listener(
    system: System, session: str, stopped_s: float, timing: Timing, actions: list[Action]
) -> Iterator[list[tuple[float, int]]]:
    """Follow a session in another process, to be stopped for some time; 0: do not.

    Yields
    ------
    list of tuple
        Complete when the context ends: when each frame came, in s, and its media time.
    """
    frames: list[tuple[float, int]] = []
    if not stopped_s:
        yield frames
        return
    listener = Listener(system.control, session)
    actions += _stopped(listener.number, timing.fault_at_s, stopped_s)
    yield frames
    frames += listener.frames()


def _open(client: Client) -> Session:
    return client.open_session(encoding="f32le")


def _open_all(client: Client, num: int) -> tuple[list[Session], int]:
    """Open sessions; return them and how many were refused, of which the first is not."""
    sessions = [_open(client)]
    num_refused = 0
    for _ in range(num - 1):
        try:
            sessions.append(_open(client))
        except Refused:
            num_refused += 1
    return sessions, num_refused


class Listener:
    """Another subscriber: a process that prints each frame, and when its lines came."""

    def __init__(self, control: str, session: str) -> None:
        environment = {**os.environ, variable(COMMON, "control"): control.partition(" ")[0]}
        self._process = subprocess.Popen(  # noqa: S603 - our own module
            [sys.executable, "-m", "kouxing", "listen", session],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._frames: list[tuple[float, int]] = []  # arrival in s, media time in samples
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,))
        self._reader.start()

    @property
    def number(self) -> int:
        """The number of the process."""
        return self._process.pid

    def frames(self) -> list[tuple[float, int]]:
        """Return when frames came, and their media times, once the session has ended."""
        self._reader.join()
        self._process.wait()
        return self._frames

    def _read(self, lines: IO[str]) -> None:
        with lines:
            for line in lines:
                media_time = to_samples(float(line.split()[0]))
                self._frames.append((time.monotonic(), media_time))
