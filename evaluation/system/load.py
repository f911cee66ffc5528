"""Measures how many live sessions a system can serve: delay, rejections, CPU and memory.

One client process speaks in all sessions in real time. Their number rises in steps beyond the limit
of the system. Each step starts new sessions. A frame's latency is the time from when the last
sample that it needs was due to its arrival, without the synthesizer's delay. Missing frames count
as late.
"""

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from kouxing_client import Client, FapFrame, Refused, Session
from rich.console import Console

from kouxing.corpora.figures import new_figure
from kouxing.corpora.parallel import num_cores
from kouxing.evaluation.percentiles import percentiles
from kouxing.evaluation.system.live import CHUNK, CHUNK_S
from kouxing.evaluation.system.systems import run_all_services
from kouxing.evaluation.system.wait import wait_until
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.service_kinds import KINDS, read_settings
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.arrays import Floats
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.errors import UserError

LIMIT_MS = 60.0  # latency limit for 95 % of the frames
CLIENT = "client"  # this process
MAX_STEPS = 8  # after the first step, which has one session
SETTLE_S = 3.0  # start of a step, which is not measured
DRAIN_S = 0.3  # time from the last chunk to the end of the sessions
PAUSE_S = 1.0  # pause between steps
MAX_LOST_S = 60.0
VOICES = (1.0, 0.86, 1.14, 0.93, 1.07)  # pitch and formants, relative to the recording
_OFFSET = 0.618  # from one speaker to the next, relative to the speech; no two are close


@dataclass(frozen=True, slots=True)
class Step:
    """Figures for a number of sessions. Memory is in MB of 2^20 bytes."""

    num_asked: int
    num_sessions: int  # admitted
    refusals: dict[str, int]  # by code
    delay_ms: dict[str, float]  # percentiles over all sessions' frames
    worst_p95_ms: float  # p95 of the worst session
    num_rest_frames: int  # frames at rest while the speaker spoke
    cpu_cores: dict[str, float]  # by service, and of the client
    memory_mb: dict[str, float]  # by service, at the end
    client_late_ms: float  # 95th percentile of how late chunks were sent


@dataclass(frozen=True, slots=True)
class Load:
    """Figures of one run."""

    steps: list[Step]
    cores: int  # cores of this machine, shared with the client
    machine_load: float  # load average of the minute before
    delay_ms: float  # delay of the synthesizer

    @property
    def summary(self) -> dict[str, float]:
        """The most sessions served, in total, per core and per used core, and their memory."""
        served = [
            step for step in self.steps if step.num_sessions and step.worst_p95_ms <= LIMIT_MS
        ]
        if not served:
            return {"sessions": 0.0}
        first, best = self.steps[0], max(served, key=lambda step: step.num_sessions)
        num_more = max(1, best.num_sessions - first.num_sessions)
        return {
            "sessions": float(best.num_sessions),
            "sessions_per_core": best.num_sessions / self.cores,
            "sessions_per_busy_core": best.num_sessions / max(sum(best.cpu_cores.values()), 1e-3),
            **{
                f"{service}_mb_per_session": (best.memory_mb[service] - first.memory_mb[service])
                / num_more
                for service in ("recognizer", "synthesizer")
            },
        }


def measure(
    paths: Sequence[Path],
    num_sessions: int,
    step_s: float,
    console: Console,
    language: str | None = None,
) -> Load:
    """Start all services, put them under load, return the figures.

    The last step has ``num_sessions``; each is measured for ``step_s``. ``language`` is the
    language of the speech. If None, it is the recognizer's. Raises ``UserError`` if a file is not
    audio or the services cannot start.
    """
    speech = np.concatenate([to_16_khz(*read_audio(path)) for path in paths])
    machine_load = os.getloadavg()[0]
    settings = {"KOUXING_CONTROL_MAX_SESSIONS": "2000"}  # so that only load causes rejections
    delay_s = read_settings().load(SynthesizerConfig).delay_ms / 1e3
    steps: list[Step] = []
    sizes = [max(1, round(num_sessions * n / MAX_STEPS)) for n in range(1, MAX_STEPS + 1)]
    with run_all_services(console, settings) as system:
        for num in sorted({1, *sizes}):
            steps.append(_step(system.control, speech, num, step_s, delay_s, language))
            time.sleep(PAUSE_S)
    return Load(steps, num_cores(), machine_load, delay_s * 1e3)


def _step(
    control: str,
    speech: Floats,
    num_asked: int,
    step_s: float,
    delay_s: float,
    language: str | None,
) -> Step:
    with connect_client(control) as client:
        generator = LoadGenerator(client, speech, num_asked, language)
        generator.start()
        from_s = time.perf_counter() + SETTLE_S
        generator.speak_until(from_s)
        generator.lateness_s.clear()
        before, client_before_s = usage_of(client), time.process_time()
        until_s = from_s + step_s
        generator.speak_until(until_s)
        after, client_after_s = usage_of(client), time.process_time()
        delays_ms = [
            np.fromiter(speaker.delays_s(delay_s, from_s, until_s), float) * 1e3
            for speaker in generator.speakers
        ]
        num_rest = sum(speaker.num_rest for speaker in generator.speakers)
        time.sleep(DRAIN_S)
        generator.close()
    return Step(
        num_asked=num_asked,
        num_sessions=len(generator.speakers),
        refusals=generator.refusals,
        delay_ms=percentiles(np.concatenate(delays_ms)) if delays_ms else {},
        worst_p95_ms=max((percentiles(values)["p95"] for values in delays_ms), default=0.0),
        num_rest_frames=num_rest,
        cpu_cores={
            name: (usage.cpu_s - before[name].cpu_s) / max(1e-3, usage.at_s - before[name].at_s)
            for name, usage in after.items()
            if name in before
        }
        | {CLIENT: (client_after_s - client_before_s) / step_s},
        memory_mb={name: usage.memory_mb for name, usage in after.items()},
        client_late_ms=float(np.percentile(generator.lateness_s or [0.0], 95)) * 1e3,
    )


@dataclass(frozen=True, slots=True)
class CumulativeUsage:
    """Resources that a service had used at its last heartbeat."""

    at_s: float
    cpu_s: float
    memory_mb: float


def usage_of(client: Client) -> dict[str, CumulativeUsage]:
    """Return the resources used by each service; raises ``UserError`` if one stays lost."""
    usage: dict[str, CumulativeUsage] = {}

    def is_complete() -> bool:
        for state in client.status().services:
            at_s = time.monotonic() - state.age_s
            cpu_s, memory_mb = state.metrics["cpu_s"], state.metrics["memory_mb"]
            usage[state.service] = CumulativeUsage(at_s, cpu_s, memory_mb)
        return usage.keys() >= {*KINDS}

    if not wait_until(is_complete, MAX_LOST_S):
        missing = ", ".join({*KINDS} - usage.keys())
        raise UserError(f"no heartbeat for {MAX_LOST_S:g} s: {missing}")
    return usage


def draw(load: Load) -> Any:
    """Plot latency, CPU and memory over the number of requested sessions."""
    requested = [step.num_asked for step in load.steps]
    figure = new_figure(12.0, 4.0)
    delay, cpu, memory = figure.subplots(1, 3)
    for key in ("p50", "p95"):
        values = [step.delay_ms.get(key, float("nan")) for step in load.steps]
        delay.plot(requested, values, "o-", label=f"{key}, all sessions")
    worst = [step.worst_p95_ms for step in load.steps]
    delay.plot(requested, worst, "s--", label="p95, worst session")
    delay.axhline(LIMIT_MS, color="grey", linestyle=":", label=f"limit, {LIMIT_MS:g} ms")
    for name in load.steps[0].cpu_cores:
        cores = [step.cpu_cores.get(name) for step in load.steps]
        cpu.plot(requested, cores, "o-", label=name)
    for name in load.steps[0].memory_mb:
        memory_mb = [step.memory_mb.get(name) for step in load.steps]
        memory.plot(requested, memory_mb, "o-", label=name)
    delay.set(ylabel="latency without the delay, ms", yscale="log")
    cpu.set(ylabel="cores busy", ylim=(0, None))
    memory.set(ylabel="memory, MB", ylim=(0, None))
    for axes in (delay, cpu, memory):
        axes.set_xlabel("requested sessions")
        axes.legend(fontsize=8)
    return figure


def speaker_audio(speech: Floats, number: int) -> Floats:
    """Return the audio of a speaker: the speech from another position, in another voice."""
    rotated = np.roll(speech, -round(number * _OFFSET * len(speech)) % len(speech))
    voice = VOICES[number % len(VOICES)]
    return rotated if voice == 1.0 else to_16_khz(rotated[:, None], round(MEDIA_RATE_HZ * voice))


@dataclass(slots=True)
class Speaker:
    """A speaker's session, and the arrival times of its frames."""

    session: Session
    sound: bytes  # 16-bit samples, repeated
    start_s: float = 0.0  # when the first sample was due, by ``time.perf_counter``
    num_sent: int = 0  # chunks
    num_rest: int = 0  # frames of a silent client, though the speaker was not silent
    arrived_s: dict[int, float] = field(default_factory=dict)  # first arrival, by media time

    @property
    def due_s(self) -> float:
        """When the last sample of the next chunk is due."""
        return self.start_s + (self.num_sent + 1) * CHUNK_S

    def send(self) -> None:
        """Send the next chunk; skip it if the queue is full."""
        size = 2 * CHUNK
        start = self.num_sent * size % (len(self.sound) // size * size)
        self.num_sent += 1
        if not self.session.try_push(self.sound[start : start + size]):
            self.session.skip(CHUNK)

    def record(self, frame: FapFrame) -> None:
        """Record the arrival of a frame."""
        if frame.media_time not in self.arrived_s:
            self.arrived_s[frame.media_time] = time.perf_counter()
        elif frame.media_time > 0:  # earlier, the speaker has not started
            self.num_rest += 1

    def delays_s(self, delay_s: float, from_s: float, until_s: float) -> Iterator[float]:
        """Yield the latencies of all frames whose audio was due in an interval, seconds.

        The synthesizer's delay is subtracted. Missing frames count as if they had arrived at the
        end. A chunk counts from when it was due, so a late client makes figures worse.
        """
        rate_hz = self.session.info["facts"]["frame_rate_hz"]
        for number in range(int((until_s - self.start_s) * rate_hz)):
            media_time = round(number / rate_hz * MEDIA_RATE_HZ)
            needed = -(-(media_time + round(delay_s * MEDIA_RATE_HZ)) // CHUNK)  # chunks
            due_s = self.start_s + max(1, needed) * CHUNK_S
            if from_s <= due_s < until_s:
                yield min(self.arrived_s.get(media_time, until_s), until_s) - due_s


class LoadGenerator:
    """Sessions of one client with audio in real time, whose chunks are spread evenly."""

    def __init__(
        self, client: Client, speech: Floats, num_speakers: int, language: str | None = None
    ) -> None:
        self.speakers: list[Speaker] = []  # admitted
        self.refusals: dict[str, int] = {}  # number by code
        self.lateness_s: list[float] = []  # how late each chunk was sent
        self._turn = 0  # index of the next speaker
        for number in range(num_speakers):
            try:
                session = client.open_session(language=language)
            except Refused as refusal:
                self.refusals[refusal.code] = self.refusals.get(refusal.code, 0) + 1
                continue
            pcm = as_integers(speaker_audio(speech, number)).tobytes()
            speaker = Speaker(session, pcm)
            session.results(FapFrame, on_result=speaker.record)
            self.speakers.append(speaker)

    def start(self) -> None:
        """Start all speakers."""
        now_s = time.perf_counter()
        for number, speaker in enumerate(self.speakers):
            speaker.start_s = now_s + CHUNK_S * number / len(self.speakers)

    def speak_until(self, end_s: float) -> None:
        """Speak until a time of ``time.perf_counter``."""
        while (now_s := time.perf_counter()) < end_s:
            if not self.speakers:
                time.sleep(end_s - now_s)
                return
            speaker = self.speakers[self._turn]  # all chunks are equally long
            remaining_s = min(speaker.due_s, end_s) - now_s
            if remaining_s > 0.0:
                time.sleep(remaining_s)
            else:
                self.lateness_s.append(now_s - speaker.due_s)
                speaker.send()
                self._turn = (self._turn + 1) % len(self.speakers)
                if self._turn == 0:
                    for speaker in self.speakers:
                        speaker.session.take_errors()  # rejected audio shows as missing frames

    def close(self) -> None:
        """End all sessions."""
        for speaker in self.speakers:
            speaker.session.close()
