"""Start the services to measure: on this host like ``kouxing run``, or on virtual hosts."""

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Self

from kouxing_client import Status
from kouxing_client.keys import Key
from rich.console import Console

from kouxing.evaluation.system.network import Network
from kouxing.evaluation.system.wait import wait_until
from kouxing.services.cli.launch.supervisor import Supervisor
from kouxing.services.service_kinds import (
    KINDS,
    extra_worker_environments,
    free_port_environment,
    read_settings,
)
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.errors import UserError
from kouxing.shared.settings.config import variable_name
from kouxing.shared.settings.keys import CLIENT, control_endpoint, load_user_key, read_key

SPARE = "spare"  # instance of a second worker of a kind, and its host
READY_S = 180.0
ON_HOSTS = ("control", "recognizer", "synthesizer")
PORTS = {  # ports of services on virtual hosts
    "control": {"control": 5550, "events": 5551},
    "recognizer": {"audio": 5560, "phones": 5561, "unpaced_audio": 5562},
    "synthesizer": {"phone_input": 5570, "faps": 5571},
}


class System:
    """Running services."""

    control: str  # address and key
    key: Key  # a client's key

    def on_client(self) -> contextlib.AbstractContextManager[None]:
        """Open the sockets of this thread on the client's host."""
        return contextlib.nullcontext()

    def process_of(self, session: str, service: str) -> int:
        """Return the id of the process that serves a session."""
        raise NotImplementedError

    def instance_of(self, session: str, service: str) -> str:
        """Return the instance of a service that serves a session; empty if none does."""
        report = self.status()
        workers = {
            worker
            for state in report.sessions
            if state.session == session
            for worker in state.workers.values()
        }
        served = (
            state.instance
            for state in report.services
            if state.service == service and state.instance in workers
        )
        return next(served, "")

    def status(self) -> Status:
        """Return the status report of control."""
        with self.on_client(), connect_client(self.control, key=self.key, timeout_s=2.0) as client:
            return client.status()


class LocalSystem(System):
    """Services on free ports of this host, which log to ``folder``.

    ``settings`` are environment variables. A second worker of the kind ``spare`` runs, if it is not
    empty. A service that ends restarts, unless there is a spare.
    """

    def __init__(
        self,
        folder: Path,
        console: Console,
        *,
        services: Collection[str] = tuple(KINDS),
        settings: Mapping[str, str] | None = None,
        spare: str = "",
    ) -> None:
        self._reserved_ports = contextlib.ExitStack()
        self.environment = {
            **free_port_environment(services, reservations=self._reserved_ports),
            "KOUXING_DRIVER_VIEW": "none",
            "KOUXING_INSECURE": "false",
            "LP_NUM_THREADS": os.environ.get("LP_NUM_THREADS", "1"),
            **(settings or {}),
        }
        self.control = control_endpoint(self.environment["KOUXING_CONTROL"], insecure=False)
        self.key = load_user_key()
        self._restarts = not spare
        self._spare_name = f"{spare}-2"
        more = {
            name: {**addresses, variable_name(spare, "instance"): SPARE}
            for name, addresses in extra_worker_environments(read_settings(), 2).items()
            if name == self._spare_name
        }
        self.supervisor = Supervisor(
            [], folder, console, self.environment, services=services, extra_workers=more
        )

    def __enter__(self) -> Self:
        try:
            self.supervisor.start()
            self.supervisor.wait_ready(self.control)
            if self._restarts:
                self.supervisor.watch()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.supervisor.stop()
        self._reserved_ports.close()

    def process_of(self, session: str, service: str) -> int:
        """Return the id of the process that serves a session."""
        is_spare = self.instance_of(session, service) == SPARE
        return self.supervisor.process(self._spare_name if is_spare else service).pid


@contextlib.contextmanager
def run_all_services(
    console: Console, settings: Mapping[str, str] | None = None
) -> Iterator[LocalSystem]:
    """Run all services on free ports of this host. Their logs are deleted at the end."""
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalSystem(Path(folder), console, settings=settings) as system,
    ):
        yield system


class HostsSystem(System):
    """Control, recognizer and synthesizer on one host each, and perhaps a spare worker.

    The keys are created on control's host and copied to the others, as in docs/hosts.md.
    """

    def __init__(self, logs: Path, states: Path, network: Network, spare: str = "") -> None:
        self.network = network
        self._logs = logs
        self._states = states  # folders of the hosts' keys
        self._services = {name: name for name in ON_HOSTS}  # by host
        if spare:
            self._services[SPARE] = spare
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        for host, service in self._services.items():
            if host != "control":
                self._add_key(host, service, f"service:{service}")
        self._add_key(CLIENT, CLIENT, "client")
        self.key = read_key(self._state(CLIENT) / "kouxing" / f"{CLIENT}.key")
        self.control = f"{self._control_address()} {self.key.control}"

    def __enter__(self) -> Self:
        try:
            for host in self._services:
                self._start(host)
            self._wait_until_ready()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.wait()

    def on_client(self) -> contextlib.AbstractContextManager[None]:
        """Open the sockets of this thread on the client's host."""
        return self.network.on(CLIENT)

    def process_of(self, session: str, service: str) -> int:
        """Return the id of the process that serves a session."""
        return self._processes[self.instance_of(session, service)].pid

    def _start(self, host: str) -> None:
        service, address = self._services[host], self.network.address(host)
        addresses = {
            variable_name(service, key): f"tcp://{address}:{port}"
            for key, port in PORTS[service].items()
        }
        environment = {
            "XDG_STATE_HOME": str(self._state(host)),
            "KOUXING_CONTROL": self._control_address(),
            "KOUXING_ADVERTISE": address,
            "KOUXING_INSECURE": "false",
        }
        module = (sys.executable, "-m", "kouxing.services.process")
        command = self.network.command(host, *module, service)
        environment |= {variable_name(service, "instance"): host}
        with (self._logs / f"{host}.log").open("wb") as log:
            self._processes[host] = subprocess.Popen(  # noqa: S603 - our own module
                command,
                env={**os.environ, **environment, **addresses},
                stderr=log,
                start_new_session=True,
            )

    def _wait_until_ready(self) -> None:
        """Wait until services have registered at control; raises ``UserError`` after READY_S."""

        def is_ready() -> bool:
            try:
                states = self.status().services
            except UserError:  # control does not run yet
                return False
            return {*self._services} <= {state.instance for state in states}

        if not wait_until(is_ready, READY_S):
            raise UserError(f"the services did not start within {READY_S:g} s")

    def _control_address(self) -> str:
        return f"tcp://{self.network.address('control')}:{PORTS['control']['control']}"

    def _add_key(self, host: str, name: str, role: str) -> None:
        """Create a key on control's host and move it to another."""
        subprocess.run(  # noqa: S603 - our own module
            [sys.executable, "-m", "kouxing", "keys", "add", host, "--role", role],
            env={**os.environ, "XDG_STATE_HOME": str(self._state("control"))},
            cwd=self._states,
            stderr=subprocess.DEVNULL,
            check=True,
        )
        folder = self._state(host) / "kouxing"
        folder.mkdir(mode=0o700, parents=True)
        (self._states / f"{host}.key").rename(folder / f"{name}.key")

    def _state(self, host: str) -> Path:
        return self._states / host
