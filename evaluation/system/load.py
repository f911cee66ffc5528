"""How many live sessions a system carries: delay, refusals, CPU and memory over their number.

One client process speaks into all sessions in real time. Their number rises in steps up to and
past what the system carries; each step begins with new sessions. A frame's delay counts from when
the last sample that it needs was due, by the client's clock, to its arrival: beyond the look-ahead,
which is the synthesizer's delay. Frames that do not come in time count as late, not as missing.
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

LIMIT_MS = 60.0  # that 95 % of the frames must come within
SERVING = ("control", "recognizer", "synthesizer")  # who watches is no part of the load
MAX_STEPS = 8  # beside the first, of one session
SETTLE_S = 3.0  # of a step, that are not measured
DRAIN_S = 0.3  # from the last chunk to the end of the sessions
REST_S = 1.0  # between steps
LOST_LIMIT_S = 60.0


@dataclass(frozen=True, slots=True)
class Step:
    """What some number of sessions brought; memory in MB of 2^20 bytes."""

    num_asked: int
    num_sessions: int  # that were admitted
    refusals: dict[str, int]  # by code
    delay_ms: dict[str, float]  # percentiles over all sessions' frames
    worst_p95_ms: float  # of the session that fares worst
    num_rest_frames: int  # frames of rest though the speaker spoke
    cpu_cores: dict[str, float]  # by service
    memory_mb: dict[str, float]  # by service, at the end
    client_late_ms: float  # by how much 95 % of the chunks were sent late at most
    client_cpu_cores: float

    @property
    def is_carried(self) -> bool:
        """Whether every admitted session had its face in time."""
        return self.num_sessions > 0 and self.worst_p95_ms <= LIMIT_MS


@dataclass(frozen=True, slots=True)
class Load:
    """Figures of one run, ready for tables or JSON."""

    steps: list[Step]
    cores: int  # of this machine; the client shares them where the services run here
    machine_load: float  # of the last minute, before
    delay_ms: float  # the look-ahead

    @property
    def best(self) -> Step | None:
        """The step with the most sessions that the system carried."""
        carried = [step for step in self.steps if step.is_carried]
        return max(carried, key=lambda step: step.num_sessions, default=None)

    @property
    def summary(self) -> dict[str, float]:
        """The most sessions carried, by cores of the machine and by those that were used."""
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
    """Start control, a recognizer and a synthesizer, and load them; return the figures.

    Parameters
    ----------
    paths
        Recordings that are spoken.
    num_sessions
        Of the last step.
    step_s
        How long each step is measured.

    Raises
    ------
    UserError
        If a file is no audio or the services cannot start.
    """
    text = read_text(paths)
    machine_load = os.getloadavg()[0]
    settings = {"KOUXING_CONTROL_MAX_SESSIONS": "2000"}  # so that what refuses is the load
    delay_s = read_settings().load(SynthesizerConfig).delay_ms / 1e3
    steps: list[Step] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalSystem(Path(folder), console, services=SERVING, settings=settings) as system,
    ):
        for number in step_sizes(num_sessions):
            steps.append(_step(system.control, text, number, step_s, delay_s))
            time.sleep(REST_S)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return Load(steps, cores or 1, machine_load, delay_s * 1e3)


def step_sizes(most: int) -> list[int]:
    """Return the numbers of sessions of the steps: one, and up to ``MAX_STEPS`` more."""
    return sorted({1, *(max(1, round(most * n / MAX_STEPS)) for n in range(1, MAX_STEPS + 1))})


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
            np.fromiter(each.delays_s(delay_s, from_s, until_s), float) * 1e3
            for each in crowd.spoken
        ]
        num_rest = sum(each.num_rest for each in crowd.spoken)
        time.sleep(DRAIN_S)
        crowd.close()
    return Step(
        num_asked=number,
        num_sessions=len(crowd.spoken),
        refusals=crowd.refusals,
        delay_ms=percentiles(np.concatenate(delays_ms)) if delays_ms else {},
        worst_p95_ms=max((percentiles(each)["p95"] for each in delays_ms), default=0.0),
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
    """What a service had used at its last heartbeat."""

    at_s: float
    cpu_s: float
    memory_mb: float


def usage_of(client: Client) -> dict[str, Usage]:
    """Return what each service has used; one that is taken for lost is waited for.

    Raises
    ------
    UserError
        If one stays lost.
    """
    end_s = time.monotonic() + LOST_LIMIT_S
    while True:
        states = client.status().services
        now_s = time.monotonic()
        usage = {
            state.service: Usage(
                now_s - state.age_s, state.metrics["cpu_s"], state.metrics["memory_mb"]
            )
            for state in states
        }
        if usage.keys() >= {*SERVING}:
            return usage
        if now_s > end_s:
            raise UserError(f"{', '.join({*SERVING} - usage.keys())}: lost for {LOST_LIMIT_S:g} s")
        time.sleep(0.1)


def show(load: Load, console: Console) -> None:
    """Print the figures as a table, and what they come to."""
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
        console.print(f"no number of sessions has 95 % of its frames within {LIMIT_MS:g} ms")
        return
    console.print(
        f"{figures['sessions']:.0f} sessions have 95 % of their frames within {LIMIT_MS:g} ms "
        f"beyond the look-ahead of {load.delay_ms:g} ms, each of them, on {load.cores} cores "
        f"(load before: {load.machine_load:.1f}): {figures['sessions_per_core']:.1f} sessions per "
        f"core, {figures['sessions_per_busy_core']:.1f} for each core that the services used. A "
        f"talking session takes {figures['recognizer_mb_per_session']:.1f} MB in the recognizer, "
        f"{figures['synthesizer_mb_per_session']:.1f} MB in the synthesizer."
    )


def draw(load: Load) -> Any:
    """Draw delay, CPU and memory over the number of sessions asked for; return the figure."""
    asked = [step.num_asked for step in load.steps]
    figure = new_figure(12.0, 4.0)
    delay, cpu, memory = figure.subplots(1, 3)
    for key in ("p50", "p95"):
        values = [step.delay_ms.get(key, float("nan")) for step in load.steps]
        delay.plot(asked, values, "o-", label=f"{key}, all sessions")
    delay.plot(asked, [step.worst_p95_ms for step in load.steps], "s--", label="p95, worst session")
    delay.axhline(LIMIT_MS, color="grey", linestyle=":", label=f"limit, {LIMIT_MS:g} ms")
    delay.set_yscale("log")
    delay.set_ylabel("sound to face beyond the look-ahead, ms")
    admitted = [step.num_sessions for step in load.steps]
    if admitted != asked:
        other = delay.twinx()
        other.plot(asked, admitted, "k.:", label="admitted")
        other.set_ylim(bottom=0)
        other.set_ylabel("sessions admitted")
    for service in load.steps[0].cpu_cores:
        cpu.plot(asked, [step.cpu_cores.get(service) for step in load.steps], "o-", label=service)
        memory.plot(
            asked, [step.memory_mb.get(service) for step in load.steps], "o-", label=service
        )
    cpu.plot(asked, [step.client_cpu_cores for step in load.steps], "k:", label="this client")
    cpu.set_ylabel("cores busy")
    memory.set_ylabel("memory, MB")
    for axes in (delay, cpu, memory):
        axes.set_xlabel("sessions asked for")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    for axes in (cpu, memory):
        axes.set_ylim(bottom=0)
    return figure
