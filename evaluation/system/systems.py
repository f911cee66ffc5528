"""Start the services to measure: on this host like ``kouxing run``, or on virtual hosts."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Protocol, Self

from kouxing_client import Status
from rich.console import Console

from kouxing.services.cli.supervisor import Supervisor
from kouxing.services.kinds import KINDS, free_addresses, more_workers, read_settings
from kouxing.shared.config import variable
from kouxing.shared.control_client import connect
from kouxing.shared.errors import UserError
from kouxing.shared.keys import CLIENT, Key, control_endpoint, read_key, user_key

SPARE = "spare"  # instance of a second worker of a kind, and its host
READY_S = 60.0
ON_HOSTS = ("control", "recognizer", "synthesizer")
PORTS = {  # of services on virtual hosts
    "control": {"control": 5550, "events": 5551},
    "recognizer": {"audio": 5560, "phones": 5561, "unpaced_audio": 5562},
    "synthesizer": {"phone_input": 5570, "faps": 5571},
}


class System(Protocol):
    """Running services and their addresses."""

    control: str  # address and key
    key: Key  # of a client

    def on_client(self) -> contextlib.AbstractContextManager[None]:
        """Open the sockets of this thread on the client's host."""

    def process_of(self, session: str, service: str) -> int:
        """Return the id of the process that serves a session."""


class Hosts(Protocol):
    """Hosts of a ``HostsSystem``, such as a ``Network``."""

    def bound(self, host: str) -> str:
        """Return the address that services on a host bind."""

    def address(self, host: str, seen_from: str) -> str:
        """Return the address of a host as seen from another one."""

    def command(self, host: str, *command: str) -> list[str]:
        """Return a command line that runs a command on a host."""

    def on(self, host: str) -> contextlib.AbstractContextManager[None]:
        """Open the sockets of this thread on a host."""

    def cut(self, host: str) -> None:
        """Drop all packets from and to a host."""

    def mend(self) -> None:
        """Connect all hosts again."""


class LocalSystem:
    """Services on free ports of this host. A service that ends restarts, unless it has a spare.

    Parameters
    ----------
    folder
        Folder for the logs.
    services
        Kinds of services.
    settings
        Additional environment variables.
    spare
        Kind of which a second one runs, or nothing.
    insecure
        Run without keys.
    """

    def __init__(
        self,
        folder: Path,
        console: Console,
        *,
        services: Collection[str] = tuple(KINDS),
        settings: Mapping[str, str] | None = None,
        spare: str = "",
        insecure: bool = False,
    ) -> None:
        environment = {
            **free_addresses(services),
            "KOUXING_DRIVER_VIEW": "none",
            "KOUXING_INSECURE": str(insecure),
            "LP_NUM_THREADS": os.environ.get("LP_NUM_THREADS", "1"),
            **(settings or {}),
        }
        self.control = control_endpoint(environment["KOUXING_CONTROL"], insecure=insecure)
        self.key = user_key()
        self._spare_kind = spare
        self._spare_name = f"{spare}-2"
        more = {
            name: {**addresses, variable(spare, "instance"): SPARE}
            for name, addresses in more_workers(read_settings(), 2).items()
            if name == self._spare_name
        }
        self.supervisor = Supervisor([], folder, console, environment, services=services, more=more)

    def __enter__(self) -> Self:
        try:
            self.supervisor.start()
            self.supervisor.wait_ready(self.control)
            if not self._spare_kind:
                self.supervisor.watch()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.supervisor.stop()

    def on_client(self) -> contextlib.AbstractContextManager[None]:
        """Do nothing: there is only one host."""
        return contextlib.nullcontext()

    def process_of(self, session: str, service: str) -> int:
        """Return the id of the process that serves a session."""
        is_spare = instance_of(self, session, service) == SPARE
        return self.supervisor.process_number(self._spare_name if is_spare else service)


class HostsSystem:
    """Control, recognizer and synthesizer on one host each, and perhaps a spare worker.

    The keys are created on control's host and copied to the others, as in docs/hosts.md.
    """

    def __init__(self, logs: Path, states: Path, network: Hosts, spare: str = "") -> None:
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
        self.control = f"{self._control_for(CLIENT)} {self.key.control}"

    def __enter__(self) -> Self:
        try:
            for host in self._services:
                self._start(host)
            wait_until_ready(self, self._services)
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
        return self._processes[self.host_of(session, service)].pid

    def host_of(self, session: str, service: str) -> str:
        """Return the host of the service that serves a session."""
        return instance_of(self, session, service)

    def _start(self, host: str) -> None:
        service, address = self._services[host], self.network.bound(host)
        addresses = {
            variable(service, key): f"tcp://{address}:{port}"
            for key, port in PORTS[service].items()
        }
        environment = {
            "XDG_STATE_HOME": str(self._state(host)),
            "KOUXING_CONTROL": self._control_for(host),
            "KOUXING_ADVERTISE": self.network.address(host, CLIENT),
            "KOUXING_INSECURE": "false",
        }
        command = self.network.command(host)
        self._processes[host] = start(
            service, host, self._logs, {**environment, **addresses}, command
        )

    def _control_for(self, host: str) -> str:
        return f"tcp://{self.network.address('control', host)}:{PORTS['control']['control']}"

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


def start(
    service: str,
    instance: str,
    folder: Path,
    environment: Mapping[str, str],
    command: Iterable[str] = (),
) -> subprocess.Popen[bytes]:
    """Start a service that logs to ``INSTANCE.log``; ``command`` runs it, on another host."""
    with (folder / f"{instance}.log").open("wb") as log:
        return subprocess.Popen(  # noqa: S603 - our own module
            [*command, sys.executable, "-m", f"kouxing.services.{service}"],
            env={**os.environ, **environment, variable(service, "instance"): instance},
            stderr=log,
            start_new_session=True,
        )


def wait_until_ready(system: System, instances: Iterable[str]) -> None:
    """Wait until services have registered at control; raises UserError after READY_S."""
    end_s = time.monotonic() + READY_S
    while True:
        with contextlib.suppress(UserError):  # control may not run yet
            if {*instances} <= {state.instance for state in status(system).services}:
                return
        if time.monotonic() > end_s:
            raise UserError(f"the services did not start within {READY_S:g} s")
        time.sleep(0.1)


def status(system: System) -> Status:
    """Return the status report of control."""
    with system.on_client(), connect(system.control, key=system.key, timeout_s=2.0) as client:
        return client.status()


def instance_of(system: System, session: str, service: str) -> str:
    """Return the instance of a service that serves a session."""
    report = status(system)
    workers = {
        worker
        for state in report.sessions
        if state.session == session
        for worker in state.workers.values()
    }
    return next(
        (
            state.instance
            for state in report.services
            if state.service == service and state.instance in workers
        ),
        "",
    )
