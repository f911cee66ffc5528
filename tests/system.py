"""A running system for tests: real processes, real sockets, ports of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Self

from kouxing_client import Client, KouxingError, Status

from kouxing.services.kinds import KINDS, free_port_environment
from kouxing.shared.config import variable
from kouxing.shared.keys import control_endpoint

ROOT = Path(__file__).parents[1]
DEMO = ROOT / "shared" / "demo"
VOWELS_FILE = ROOT / "tests" / "sounds" / "vowels-male.wav"  # a o e i u ü, with pauses between
PATIENT = {"KOUXING_CONTROL_LOST_AFTER_S": "60"}  # no service is lost on a busy machine
ANY_LOAD = {"KOUXING_CONTROL_MAX_LOAD": "1000"}  # nor is a session refused
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}
MAX_KEPT = 200

_kept: deque[socket.socket] = deque()


def free_port() -> int:
    """Return a port that no other program is given before a test binds it."""
    return _keep("127.0.0.1", 0)


def own_addresses(
    names: Collection[str] = tuple(KINDS), hosts: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return an environment in which services bind ports that no other program is given."""
    addresses = free_port_environment(names, hosts)
    for address in set(addresses.values()):
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        _keep(host or "127.0.0.1", int(port))
    return addresses


def _keep(host: str, port: int) -> int:
    # Bound but not listening, so that only those can bind it, too, that allow it (SO_REUSEADDR), as
    # servers do, and are told the port.
    kept = socket.socket()
    kept.bind((host, port))
    kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    _kept.append(kept)
    if len(_kept) > MAX_KEPT:
        _kept.popleft().close()
    found: int = kept.getsockname()[1]
    return found


def own_environment(folder: Path) -> dict[str, str]:
    """Return an environment in which all services run on ports of their own, driver headless."""
    own = {"XDG_RUNTIME_DIR": str(folder)}  # where its user's commands would find it
    return {
        **os.environ,
        **ONE_THREAD,
        **headless(folder),
        **ANY_LOAD,
        **own_addresses(),
        **own,
    }


def headless(folder: Path) -> dict[str, str]:
    """Return the settings of a driver that has no window and writes small videos."""
    return {
        "KOUXING_DRIVER_VIEW": "none",
        "KOUXING_DRIVER_OUT": str(folder),
        "KOUXING_DRIVER_WIDTH_PX": "320",
        "KOUXING_DRIVER_HEIGHT_PX": "240",
    }


def kouxing(
    *arguments: object,
    control: str = "",
    environment: dict[str, str] | None = None,
    stdin: bytes | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run the command line to its end; no input may bring a traceback."""
    environment = {**os.environ, **ONE_THREAD, "COLUMNS": "200", **(environment or {})}
    if control:
        environment["KOUXING_CONTROL"] = control.partition(" ")[0]
    result = subprocess.run(
        [sys.executable, "-m", "kouxing", *map(str, arguments)],
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
        *,
        insecure: bool = False,
    ) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._services = list(services)
        addresses = own_addresses(self._services, hosts)
        self.ports = {int(address.rpartition(":")[2]) for address in addresses.values()}
        self.environment = {
            **os.environ,
            **ONE_THREAD,
            **headless(folder),
            **PATIENT,
            **ANY_LOAD,
            **addresses,
            "KOUXING_INSECURE": str(insecure),
            **(settings or {}),
        }
        self.control = control_endpoint(self.environment["KOUXING_CONTROL"], insecure=insecure)
        self._is_insecure = insecure

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
                process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                raise AssertionError(f"{service} did not stop: {self.log(service)}") from None

    def start(self, service: str, name: str = "", **settings: str) -> None:
        """Start a service, under another name if one of its kind runs already."""
        name = name or service
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", f"kouxing.services.{service}"],
                env={**self.environment, **settings},
                cwd=ROOT,
                stderr=log,
                stdout=log,
            )

    def start_beside(self, service: str, name: str) -> None:
        """Start one more service of a kind that runs already and wait until control knows it."""
        addresses = own_addresses([service])
        self.start(service, name, **addresses, **{variable(service, "instance"): name})
        self.wait_until(lambda report: name in {state.instance for state in report.services})

    def client(self, timeout_s: float = 10.0) -> Client:
        """Return a client of the system."""
        return Client(self.control, timeout_s=timeout_s, insecure=self._is_insecure)

    def log(self, service: str) -> str:
        return (self.folder / f"{service}.log").read_text(encoding="utf-8")

    def wait_ready(self) -> None:
        self.wait_until(
            lambda report: {state.service for state in report.services} >= set(self.processes)
        )

    def wait_until(self, condition: Callable[[Status], bool], deadline_s: float = 110.0) -> None:
        """Wait until control reports what is wanted; no service may end meanwhile."""
        end_s = time.monotonic() + deadline_s
        with self.client(timeout_s=2.0) as client:
            while time.monotonic() < end_s:
                self.assert_all_alive()
                with contextlib.suppress(KouxingError):  # control may not run yet
                    if condition(client.status()):
                        return
                time.sleep(0.05)
        raise AssertionError("the services did not become ready")

    def endpoints(self) -> dict[str, str]:
        """Return where every socket of the services is bound, with its key, by name."""
        with self.client() as client:
            services = client.status().services
        return {name: each for state in services for name, each in state.endpoints.items()}

    def num_gaps(self) -> float:
        """Return how many gaps there were in the sound of all sessions."""
        time.sleep(0.6)  # until the next heartbeat
        with self.client() as client:
            metrics = {state.service: state.metrics for state in client.status().services}
        return metrics["recognizer"].get("audio_gaps", 0.0)

    def assert_all_alive(self) -> None:
        for service, process in self.processes.items():
            assert process.poll() is None, f"{service} ended: {self.log(service)}"
