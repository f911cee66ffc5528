"""What arrives at other programs that show the face: how many frames, and how evenly.

The services run as under ``kouxing run``, ``kouxing send`` beside them as a process of its own, a
viewer is at the gateway, and a sound is streamed in real time. Each receiver notes when a frame is
complete there. *Jitter* is by how much the time between two frames differs from the frames' own
period.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import aiohttp
import numpy as np
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.system.latency import percentiles, stream
from kouxing.evaluation.system.vtube_studio import VTubeStudioStub
from kouxing.services.cli.supervisor import Supervisor
from kouxing.services.gateway.wire import SHAPES_TYPE
from kouxing.services.kinds import free_addresses
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.audio_file import read_audio
from kouxing.shared.client import Client
from kouxing.shared.keys import control_endpoint, key_folder

# what is sent, and the bytes by which a frame's last datagram (or only one) is known
TARGETS = {
    "vmc://{}": b"/VMC/Ext/Blend/Apply",
    "vmc://{}?shapes=arkit": b"/VMC/Ext/Blend/Apply",
    "vmc://{}?delay=100": b"/VMC/Ext/Blend/Apply",
    "livelink://{}": b"kouxing",
    "osc://{}": b"/kouxing/time",
}
VIEWER = "viewer?shapes=arkit"
SETTLE_S = 3.0  # for the senders to start; of the speech, what is not counted


@dataclass(frozen=True, slots=True)
class Arrival:
    """Figures of one target, ready for a table or JSON."""

    target: str
    rate_hz: float
    jitter_ms: dict[str, float]
    num_frames: int


def measure(path: Path, min_s: float, console: Console) -> list[Arrival]:
    """Start the services and the senders, stream the file again and again; return the figures.

    Parameters
    ----------
    min_s
        How long to speak at least.

    Raises
    ------
    UserError
        If the file is no audio or the services cannot start.
    """
    samples, rate_hz = read_audio(path)
    num_times = max(1, round(min_s * rate_hz / len(samples)))
    speech = np.ascontiguousarray(np.concatenate([samples] * num_times))
    config = SynthesizerConfig()
    environment = {
        **free_addresses(), "KOUXING_DRIVER_VIEW": "none", "KOUXING_INSECURE": "false",
    }  # fmt: skip
    control = control_endpoint(environment["KOUXING_CONTROL"], insecure=False)
    with contextlib.ExitStack() as stack:
        receivers = {url: stack.enter_context(_Receiver(mark)) for url, mark in TARGETS.items()}
        stub = stack.enter_context(VTubeStudioStub())
        urls = [url.format(f"127.0.0.1:{each.port}") for url, each in receivers.items()]
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        supervisor = Supervisor([], Path(folder), console, environment)
        stack.callback(supervisor.stop)
        supervisor.start()
        supervisor.wait_ready(control)
        with (
            _sending([*urls, f"vts://127.0.0.1:{stub.port}"], environment, folder),
            _Viewer(int(environment["KOUXING_GATEWAY_PORT"])) as viewer,
            Client(control) as client,
        ):
            time.sleep(SETTLE_S)
            begin_s = time.perf_counter() + SETTLE_S
            stream(client, speech, rate_hz, config.delay_ms / 1e3)
            end_s = begin_s - SETTLE_S + len(speech) / rate_hz
            arrived = {url.format("HOST"): each.arrived_s for url, each in receivers.items()}
            arrived["vts://HOST"] = stub.arrived_s
            arrived[f"ws://HOST/{VIEWER}"] = viewer.arrived_s
            return [
                _figures(target, [t for t in times if begin_s <= t < end_s], config.frame_rate_hz)
                for target, times in arrived.items()
            ]


def show(arrivals: list[Arrival], console: Console) -> None:
    """Print the figures as a table."""
    table = Table("target", "frames a second", "jitter p50 ms", "p95 ms", "p99 ms")
    for each in arrivals:
        jitter = (f"{each.jitter_ms[key]:.1f}" for key in ("p50", "p95", "p99"))
        table.add_row(each.target, f"{each.rate_hz:.1f}", *jitter)
    console.print(table)


class _Receiver:
    """A program that listens at a free port, and notes when frames are complete."""

    def __init__(self, mark: bytes) -> None:
        self.arrived_s: list[float] = []
        self._mark = mark
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:
            last.sendto(b"", ("127.0.0.1", self.port))
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        while datagram := self._socket.recv(2000):
            if self._mark in datagram:
                self.arrived_s.append(time.perf_counter())


class _Viewer:
    """A program at the gateway's WebSocket that notes when frames come."""

    def __init__(self, port: int) -> None:
        self.arrived_s: list[float] = []
        self._url = f"ws://127.0.0.1:{port}/{VIEWER}"
        self._loop = asyncio.new_event_loop()
        self._task = self._loop.create_task(self._run())
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=[self._task])

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()
        self._loop.close()

    async def _run(self) -> None:
        with contextlib.suppress(asyncio.CancelledError):
            async with aiohttp.ClientSession() as http, http.ws_connect(self._url) as viewer:
                async for message in viewer:
                    if message.type is aiohttp.WSMsgType.BINARY and message.data[0] == SHAPES_TYPE:
                        self.arrived_s.append(time.perf_counter())


@contextlib.contextmanager
def _sending(urls: list[str], environment: dict[str, str], state_folder: str) -> Iterator[None]:
    """Run ``kouxing send``; the token that it gets is kept in a folder of the measurement."""
    shutil.copytree(key_folder(), Path(state_folder) / "state" / "kouxing")
    sender = subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-m", "kouxing", "send", *urls],
        env={**os.environ, **environment, "XDG_STATE_HOME": str(Path(state_folder) / "state")},
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        sender.terminate()
        sender.wait()


def _figures(target: str, arrived_s: list[float], frame_rate_hz: float) -> Arrival:
    steps_ms = np.diff(arrived_s) * 1e3
    length_s = arrived_s[-1] - arrived_s[0]
    return Arrival(
        target=target,
        rate_hz=len(steps_ms) / length_s,
        jitter_ms=percentiles(np.abs(steps_ms - 1e3 / frame_rate_hz)),
        num_frames=len(arrived_s),
    )
