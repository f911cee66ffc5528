"""Measure how many live sessions a system can serve: delay, refusals, CPU and memory.

One client process speaks in all sessions in real time. Their number rises in steps beyond the limit
of the system. Each step starts new sessions. A frame's latency is the time from when the last
sample that it needs was due to its arrival, without the synthesizer's delay. Missing frames count
as late.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from kouxing_client import Client
from rich.console import Console
from rich.table import Table

from kouxing.corpora.figures import new_figure
from kouxing.evaluation.system.latency import percentiles
from kouxing.evaluation.system.speakers import Crowd, read_text
from kouxing.evaluation.system.systems import LocalSystem
from kouxing.services.kinds import read_settings
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.control_client import connect
from kouxing.shared.errors import UserError

LIMIT_MS = 60.0  # latency limit for 95 % of the frames
SERVICES = ("control", "recognizer", "synthesizer")  # services under load
MAX_STEPS = 8  # after the first step, which has one session
SETTLE_S = 3.0  # start of a step, which is not measured
DRAIN_S = 0.3  # from the last chunk to the end of the sessions
PAUSE_S = 1.0  # between steps
MAX_LOST_S = 60.0


@dataclass(frozen=True, slots=True)
class Step:
    """Figures for a number of sessions. Memory is in MB of 2^20 bytes."""

    num_asked: int
    num_sessions: int  # admitted
    refusals: dict[str, int]  # by code
    delay_ms: dict[str, float]  # percentiles over all sessions' frames
    worst_p95_ms: float  # of the worst session
    num_rest_frames: int  # frames at rest while the speaker spoke
    cpu_cores: dict[str, float]  # by service
    memory_mb: dict[str, float]  # by service, at the end
    client_late_ms: float  # 95th percentile of how late chunks were sent
    client_cpu_cores: float

    @property
    def is_served(self) -> bool:
        """Whether every admitted session was within the limit."""
        return self.num_sessions > 0 and self.worst_p95_ms <= LIMIT_MS


@dataclass(frozen=True, slots=True)
class Load:
    """Figures of one run."""

    steps: list[Step]
    cores: int  # of this machine, shared with the client
    machine_load: float  # load average of the minute before
    delay_ms: float  # of the synthesizer

    @property
    def best(self) -> Step | None:
        """The step with the most sessions that the system served."""
        served = [step for step in self.steps if step.is_served]
        return max(served, key=lambda step: step.num_sessions, default=None)

    @property
    def summary(self) -> dict[str, float]:
        """The most sessions served, in total, per core and per used core."""
        best = self.best
        if best is None:
            return {"sessions": 0.0}
        used = sum(best.cpu_cores.values())
        slope_mb = {
            service: (memory_mb - self.steps[0].memory_mb[service])
            / max(1, best.num_sessions - self.steps[0].num_sessions)
            for service, memory_mb in best.memory_mb.items()
        }
        return {
            "sessions": float(best.num_sessions),
            "sessions_per_core": best.num_sessions / self.cores,
            "sessions_per_busy_core": best.num_sessions / max(used, 1e-3),
            "recognizer_mb_per_session": slope_mb.get("recognizer", 0.0),
            "synthesizer_mb_per_session": slope_mb.get("synthesizer", 0.0),
        }


def measure(
    paths: Sequence[Path],
    num_sessions: int,
    step_s: float,
    console: Console,
) -> Load:
    """Start control, a recognizer and a synthesizer, put them under load, return the figures.

    Parameters
    ----------
    paths
        Recordings to speak.
    num_sessions
        Number of sessions of the last step.
    step_s
        Measured time of each step.
    console
        For progress messages.

    Raises
    ------
    UserError
        If a file is not audio or the services cannot start.
    """
    text = read_text(paths)
    machine_load = os.getloadavg()[0]
    settings = {"KOUXING_CONTROL_MAX_SESSIONS": "2000"}  # so that only load causes refusals
    delay_s = read_settings().load(SynthesizerConfig).delay_ms / 1e3
    steps: list[Step] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalSystem(Path(folder), console, services=SERVICES, settings=settings) as system,
    ):
        for number in step_sizes(num_sessions):
            steps.append(_step(system.control, text, number, step_s, delay_s))
            time.sleep(PAUSE_S)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return Load(steps, cores or 1, machine_load, delay_s * 1e3)


def step_sizes(maximum: int) -> list[int]:
    """Return the number of sessions of each step."""
    return sorted({1, *(max(1, round(maximum * n / MAX_STEPS)) for n in range(1, MAX_STEPS + 1))})


def _step(control: str, text: Any, number: int, step_s: float, delay_s: float) -> Step:
    with connect(control) as client:
        crowd = Crowd(client, text, number)
        crowd.start()
        from_s = time.perf_counter() + SETTLE_S
        crowd.speak_until(from_s)
        crowd.lateness_s.clear()
        before, client_before_s = usage_of(client), time.process_time()
        until_s = from_s + step_s
        crowd.speak_until(until_s)
        after, client_after_s = usage_of(client), time.process_time()
        delays_ms = [
            np.fromiter(spoken.delays_s(delay_s, from_s, until_s), float) * 1e3
            for spoken in crowd.spoken
        ]
        num_rest = sum(spoken.num_rest for spoken in crowd.spoken)
        time.sleep(DRAIN_S)
        crowd.close()
    return Step(
        num_asked=number,
        num_sessions=len(crowd.spoken),
        refusals=crowd.refusals,
        delay_ms=percentiles(np.concatenate(delays_ms)) if delays_ms else {},
        worst_p95_ms=max((percentiles(values)["p95"] for values in delays_ms), default=0.0),
        num_rest_frames=num_rest,
        cpu_cores={
            name: (usage.cpu_s - before[name].cpu_s) / max(1e-3, usage.at_s - before[name].at_s)
            for name, usage in after.items()
            if name in before
        },
        memory_mb={name: usage.memory_mb for name, usage in after.items()},
        client_late_ms=float(np.percentile(crowd.lateness_s or [0.0], 95)) * 1e3,
        client_cpu_cores=(client_after_s - client_before_s) / step_s,
    )


@dataclass(frozen=True, slots=True)
class Usage:
    """Resources that a service had used at its last heartbeat."""

    at_s: float
    cpu_s: float
    memory_mb: float


def usage_of(client: Client) -> dict[str, Usage]:
    """Return the resources used by each service; wait for services that are lost.

    Raises
    ------
    UserError
        If a service stays lost.
    """
    end_s = time.monotonic() + MAX_LOST_S
    while True:
        states = client.status().services
        now_s = time.monotonic()
        usage = {
            state.service: Usage(
                now_s - state.age_s, state.metrics["cpu_s"], state.metrics["memory_mb"]
            )
            for state in states
        }
        if usage.keys() >= {*SERVICES}:
            return usage
        if now_s > end_s:
            missing = ", ".join({*SERVICES} - usage.keys())
            raise UserError(f"no heartbeat for {MAX_LOST_S:g} s: {missing}")
        time.sleep(0.1)


def show(load: Load, console: Console) -> None:
    """Print the figures as tables, with a summary."""
    delays = Table("sessions", "refused", "p50 ms", "p95 ms", "worst p95", "at rest", "sent late")
    services = list(load.steps[0].cpu_cores)
    costs = Table(
        "sessions", *(f"{service}: cores, MB" for service in services), "this client: cores"
    )
    for step in load.steps:
        delays.add_row(
            str(step.num_sessions),
            ", ".join(f"{number} {code}" for code, number in step.refusals.items()) or "0",
            *(f"{step.delay_ms[key]:.1f}" if step.delay_ms else "" for key in ("p50", "p95")),
            f"{step.worst_p95_ms:.1f}",
            str(step.num_rest_frames),
            f"{step.client_late_ms:.1f}",
        )
        costs.add_row(
            str(step.num_sessions),
            *(
                f"{step.cpu_cores.get(service, 0):.2f}, {step.memory_mb.get(service, 0):.0f}"
                for service in services
            ),
            f"{step.client_cpu_cores:.2f}",
        )
    console.print(delays)
    console.print(costs)
    figures = load.summary
    if load.best is None:
        console.print(f"not even one session has 95 % of its frames within {LIMIT_MS:g} ms")
        return
    console.print(
        f"{figures['sessions']:.0f} sessions have 95 % of their frames within {LIMIT_MS:g} ms plus "
        f"{load.delay_ms:g} ms of delay, on {load.cores} cores (load before: "
        f"{load.machine_load:.1f}): {figures['sessions_per_core']:.1f} sessions per core, "
        f"{figures['sessions_per_busy_core']:.1f} per used core. A session needs "
        f"{figures['recognizer_mb_per_session']:.1f} MB in the recognizer and "
        f"{figures['synthesizer_mb_per_session']:.1f} MB in the synthesizer."
    )


def draw(load: Load) -> Any:
    """Plot latency, CPU and memory over the number of requested sessions."""
    requested = [step.num_asked for step in load.steps]
    figure = new_figure(12.0, 4.0)
    delay, cpu, memory = figure.subplots(1, 3)
    for key in ("p50", "p95"):
        values = [step.delay_ms.get(key, float("nan")) for step in load.steps]
        delay.plot(requested, values, "o-", label=f"{key}, all sessions")
    delay.plot(
        requested, [step.worst_p95_ms for step in load.steps], "s--", label="p95, worst session"
    )
    delay.axhline(LIMIT_MS, color="grey", linestyle=":", label=f"limit, {LIMIT_MS:g} ms")
    delay.set_yscale("log")
    delay.set_ylabel("latency without the delay, ms")
    admitted = [step.num_sessions for step in load.steps]
    if admitted != requested:
        right = delay.twinx()
        right.plot(requested, admitted, "k.:", label="admitted")
        right.set_ylim(bottom=0)
        right.set_ylabel("sessions admitted")
    for service in load.steps[0].cpu_cores:
        cpu.plot(
            requested, [step.cpu_cores.get(service) for step in load.steps], "o-", label=service
        )
        memory.plot(
            requested, [step.memory_mb.get(service) for step in load.steps], "o-", label=service
        )
    cpu.plot(requested, [step.client_cpu_cores for step in load.steps], "k:", label="this client")
    cpu.set_ylabel("cores busy")
    memory.set_ylabel("memory, MB")
    for axes in (delay, cpu, memory):
        axes.set_xlabel("requested sessions")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    for axes in (cpu, memory):
        axes.set_ylim(bottom=0)
    return figure
