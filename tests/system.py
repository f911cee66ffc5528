"""A running system for tests: real processes, real sockets, ports of its own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Self

from shared.client import Client
from shared.errors import UserError

ROOT = Path(__file__).parents[1]
DEMO = ROOT / "shared" / "demo"
BINDS = {
    "control": ("COMMANDS", "EVENTS"),
    "recognizer": ("AUDIO", "PHONES"),
    "synthesizer": ("PHONES", "FAPS"),
    "driver": (),
    "gateway": (),
}
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}


def free_port(host: str = "127.0.0.1") -> int:
    with socket.socket() as probe:
        probe.bind((host, 0))
        port: int = probe.getsockname()[1]
    return port


def own_environment(folder: Path) -> dict[str, str]:
    """Return an environment in which all services run on ports of their own, driver headless."""
    environment = {
        **os.environ,
        **ONE_THREAD,
        "KOUXING_GATEWAY_PORT": str(free_port()),
        "KOUXING_DRIVER_VIEW": "none",
        "KOUXING_DRIVER_OUT": str(folder),
        "KOUXING_DRIVER_WIDTH_PX": "320",
        "KOUXING_DRIVER_HEIGHT_PX": "240",
    }
    for service, keys in BINDS.items():
        for key in keys:
            endpoint = f"tcp://127.0.0.1:{free_port()}"
            environment[f"KOUXING_{service.upper()}_{key}"] = endpoint
    environment["KOUXING_CONTROL"] = environment["KOUXING_CONTROL_COMMANDS"]
    return environment


def kouxing(
    *arguments: object,
    control: str = "",
    environment: dict[str, str] | None = None,
    stdin: bytes | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run the command line to its end; no input may bring a traceback."""
    environment = {**os.environ, **ONE_THREAD, "COLUMNS": "200", **(environment or {})}
    if control:
        environment["KOUXING_CONTROL"] = control
    result = subprocess.run(
        [sys.executable, "-m", "services", *map(str, arguments)],
        env=environment,
        cwd=ROOT,
        capture_output=True,
        input=stdin,
        timeout=110,
        check=False,
    )
    texts = (result.stdout.decode(), result.stderr.decode())
    assert "Traceback" not in texts[1], texts[1]
    return subprocess.CompletedProcess(result.args, result.returncode, *texts)


class System:
    """Services as processes, each on the address given for it."""

    def __init__(
        self,
        services: Iterable[str],
        folder: Path,
        hosts: dict[str, str] | None = None,
        settings: dict[str, str] | None = None,
    ) -> None:
        hosts = hosts or {}
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._services = list(services)
        self.environment = {
            **os.environ,
            **ONE_THREAD,
            "KOUXING_DRIVER_VIEW": "none",
            "KOUXING_DRIVER_OUT": str(folder),
            "KOUXING_DRIVER_WIDTH_PX": "320",
            "KOUXING_DRIVER_HEIGHT_PX": "240",
        }
        self.ports: dict[str, int] = {}
        for service in self._services:
            host = hosts.get(service, "127.0.0.1")
            for key in BINDS[service]:
                port = self.ports[f"{service}.{key.lower()}"] = free_port(host)
                variable = f"KOUXING_{service.upper()}_{key}"
                self.environment[variable] = f"tcp://{host}:{port}"
        if "gateway" in self._services:
            self.ports["gateway"] = free_port()
            self.environment["KOUXING_GATEWAY_PORT"] = str(self.ports["gateway"])
        self.control = self.environment["KOUXING_CONTROL_COMMANDS"]
        self.environment["KOUXING_CONTROL"] = self.control
        self.environment.update(settings or {})

    def __enter__(self) -> Self:
        try:
            for service in self._services:
                self.start(service)
            self.wait_ready()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        for process in self.processes.values():
            process.send_signal(signal.SIGCONT)
            process.terminate()
        for service, process in self.processes.items():
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                raise AssertionError(f"{service} did not stop: {self.log(service)}") from None

    def start(self, service: str) -> None:
        with (self.folder / f"{service}.log").open("ab") as log:
            self.processes[service] = subprocess.Popen(
                [sys.executable, "-m", f"services.{service}"],
                env=self.environment,
                cwd=ROOT,
                stderr=log,
                stdout=log,
            )

    def log(self, service: str) -> str:
        return (self.folder / f"{service}.log").read_text(encoding="utf-8")

    def wait_ready(self, deadline_s: float = 60.0) -> None:
        end_s = time.monotonic() + deadline_s
        with Client(self.control, deadline_s=2.0) as client:
            while time.monotonic() < end_s:
                for service, process in self.processes.items():
                    assert process.poll() is None, f"{service} ended: {self.log(service)}"
                try:
                    alive = {state.service for state in client.status().services}
                except UserError:
                    continue
                if alive >= set(self.processes):
                    return
                time.sleep(0.05)
        raise AssertionError("the services did not become ready")

    def assert_all_alive(self) -> None:
        for service, process in self.processes.items():
            assert process.poll() is None, f"{service} ended: {self.log(service)}"
