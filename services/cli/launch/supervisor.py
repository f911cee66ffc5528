"""Runs all services on one machine, and restarts a service that crashes or hangs.

The packages supervisor and honcho are not used, because they do not detect a process that hangs.
"""

import contextlib
import errno
import json
import math
import os
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from kouxing_client import KouxingError
from rich.console import Console

from kouxing.services.cli.launch.log_file import LogFile
from kouxing.services.cli.launch.service_process import HANG_S, POLL_S, ServiceProcess
from kouxing.services.service_kinds import KINDS, WORKERS, kind_of
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.errors import USER_ERROR, UserError, prefix_name
from kouxing.shared.service.base import DRAIN_TIMEOUT_S

MIN_BACKOFF_S, MAX_BACKOFF_S = 0.2, 5.0  # delays before restarting a service that crashed twice
START_TIMEOUT_S = 120.0
STEADY_S = 10.0  # a service that has run for longer restarts without delay
WORKER_HANG_S = 2.0  # workers never work for long at a time, unless the machine is overloaded


@dataclass(slots=True, eq=False)
class _Service:
    """One service, and its process while it runs."""

    name: str
    log_path: Path
    environment: Mapping[str, str]  # additions to the supervisor's
    process: ServiceProcess | None = None
    log_thread: threading.Thread | None = None  # copies the log of the process
    started_s: float = -math.inf
    restart_at_s: float = math.inf
    backoff_s: float = 0.0  # delay before the restart after an early crash
    has_been_ready: bool = False  # one of its processes was ready
    is_restarting: bool = False  # restarted, but not ready yet
    error: str = ""  # error in the configuration that the process printed

    @property
    def hang_limit_s(self) -> float:
        """The hang limit: short for a worker, unless it has already been restarted twice."""
        is_fresh = self.backoff_s <= MIN_BACKOFF_S
        return WORKER_HANG_S if kind_of(self.name) in WORKERS and is_fresh else HANG_S


class Supervisor:
    """Runs each service in a process, with one log of JSON lines per service in ``log_folder``.

    Warnings also go to the console. ``arguments`` are the command-line arguments of every service,
    and ``environment`` is added to this process's. ``extra_workers`` names more workers, such as
    ``recognizer-2``, with their additions to the environment
    (`services.service_kinds.extra_worker_environments`).
    """

    def __init__(
        self,
        arguments: list[str],
        log_folder: Path,
        console: Console,
        environment: Mapping[str, str] | None = None,
        *,
        services: Collection[str] = tuple(KINDS),
        extra_workers: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        self._arguments = arguments
        self._log_folder = log_folder
        self._console = console
        self._environment = {**os.environ, **(environment or {})}
        self._additions = {**{name: {} for name in services}, **(extra_workers or {})}
        self._services: dict[str, _Service] = {}
        self._watcher: threading.Thread | None = None
        self._stopping = threading.Event()
        self._process_ended = threading.Event()
        self._failure: UserError | None = None
        path = log_folder
        try:
            log_folder.mkdir(parents=True, exist_ok=True)
            for path in map(self._log_path, self._additions):
                LogFile(path, self._warn).check()
        except OSError as error:
            raise UserError(
                f"cannot write {path}: {error.strerror}; start kouxing in a folder that"
                " you can write to, or add --set driver.out=FOLDER"
            ) from None

    def start(self) -> None:
        """Start every service."""
        for name, additions in self._additions.items():
            self.start_service(name, additions)

    def start_service(self, name: str, additions: Mapping[str, str]) -> None:
        """Start a service, or start it again, with additions to the environment.

        Raises ``UserError`` if the system allows no more processes, threads or open files.
        """
        service = self._services[name] = _Service(name, self._log_path(name), additions)
        try:
            self._start(service)
        except OSError as error:
            raise UserError(
                f"cannot start {name}: {error.strerror}; close other programs, or raise the limits"
                " 'ulimit -u' and 'ulimit -n'"
            ) from None

    def wait_ready(self, control: str) -> None:
        """Wait until all services have registered with control.

        Raises ``UserError`` if a service cannot start, or not within ``START_TIMEOUT_S``.
        """
        end_s = time.monotonic() + START_TIMEOUT_S
        with connect_client(control, timeout_s=2.0) as client:
            while time.monotonic() < end_s:
                self.check()
                with contextlib.suppress(KouxingError):  # control does not run yet
                    ready = Counter(service.service for service in client.status().services)
                    if ready >= Counter(map(kind_of, self._services)):
                        return
                time.sleep(0.1)
        raise UserError(f"the services did not start; see their logs in {self._log_folder}")

    def page_address(self, control: str) -> str:
        """Return the address of the gateway's page, including its token.

        Raises ``UserError`` if the gateway has stopped.
        """
        with connect_client(control) as client:
            services = client.status().services
        for service in services:
            if service.service == "gateway":
                return service.endpoints["page"].removesuffix("/")
        raise UserError(f"the gateway stopped; see {self._log_path('gateway')}")

    def watch(self) -> None:
        """Restart crashed services from now on, in a thread; see also ``wait``."""
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    def wait(self) -> None:
        """Wait until ``stop`` is called.

        Raises ``UserError`` if a service cannot start because of a wrong configuration.
        """
        self._stopping.wait()
        if self._failure is not None:
            raise self._failure

    def check(self) -> None:
        """Kill services that hang, and restart those that have ended.

        Raises ``UserError`` if a service cannot start because of a wrong configuration.
        """
        now_s = time.monotonic()
        processes = self._processes()
        for process in processes:
            process.read_heartbeats()
        if len(processes) > 1 and all(process.is_unresponsive for process in processes):
            for process in processes:  # all processes were stopped, so none of them hangs
                process.reset_heartbeat_gap()
        for service in self._services.values():
            if service.process is not None:
                self._check_process(service, service.process, now_s)
            if service.process is None and now_s >= service.restart_at_s:
                service.is_restarting = True
                try:
                    self._start(service)
                except OSError as error:  # such as too many processes or open files
                    service.restart_at_s = now_s + MAX_BACKOFF_S
                    self._warn(
                        f"{service.name} cannot start: {error.strerror}; trying again in"
                        f" {MAX_BACKOFF_S:g} s"
                    )

    def process(self, name: str) -> ServiceProcess:
        """Return the process of a service; raises ``KeyError`` if it does not run."""
        process = self._services[name].process
        if process is None:
            raise KeyError(name)
        return process

    def stop(self) -> None:
        """Ask every service to stop, and kill those that do not stop in time."""
        self._stopping.set()
        if self._watcher is not None:
            self._watcher.join()
        for process in self._processes():
            process.send_signal(signal.SIGTERM)
        end_s = time.monotonic() + DRAIN_TIMEOUT_S + 1.0
        for process in self._processes():
            try:
                process.wait(max(0.1, end_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for service in self._services.values():
            service.process = None

    def _log_path(self, name: str) -> Path:
        return self._log_folder / f"{name}.log"

    def _processes(self) -> list[ServiceProcess]:
        return [s.process for s in self._services.values() if s.process is not None]

    def _watch(self) -> None:
        while not self._stopping.is_set():
            self._process_ended.wait(POLL_S)
            self._process_ended.clear()
            try:
                self.check()
            except UserError as error:
                self._failure = error
                self._stopping.set()

    def _check_process(self, service: _Service, process: ServiceProcess, now_s: float) -> None:
        status = process.poll()
        service.has_been_ready |= process.is_ready
        if status is None:
            if process.is_hung:
                self._warn(f"{service.name} is not responding; killing it")
                process.kill()
            elif process.is_ready and service.is_restarting:
                service.is_restarting = False
                self._print(f"{service.name} is running again", "green")
            return
        ended = f"{service.name} ended with status {status}"
        if status == USER_ERROR:
            if service.log_thread is not None:
                service.log_thread.join()
            ended = service.error or f"{service.name} cannot start; see {service.log_path}"
            if not service.has_been_ready:
                raise UserError(ended)
        service.process = None
        is_steady = now_s - service.started_s > STEADY_S
        wait_s = 0.0 if is_steady else service.backoff_s
        service.backoff_s = min(max(2 * wait_s, MIN_BACKOFF_S), MAX_BACKOFF_S)
        service.restart_at_s = now_s + wait_s
        when = f"in {wait_s:g} s" if wait_s else "now"
        self._warn(f"{ended}; restarting {service.name} {when}")

    def _start(self, service: _Service) -> None:
        process = service.process = ServiceProcess(
            kind_of(service.name),
            self._arguments,
            environment={**self._environment, **service.environment},
            hang_limit_s=service.hang_limit_s,
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C must reach only the supervisor
        )
        service.started_s = time.monotonic()
        service.error = ""
        service.log_thread = threading.Thread(
            target=self._copy_log_until_end, args=(service, process), daemon=True
        )
        try:
            service.log_thread.start()
        except RuntimeError as error:  # too many threads
            process.kill()
            process.wait()
            service.process = None
            raise OSError(errno.EAGAIN, str(error)) from error

    def _copy_log_until_end(self, service: _Service, process: ServiceProcess) -> None:
        """Copy a service's log until it ends, then wake the watcher."""
        if process.stderr is not None:
            self._copy_log(service, process.stderr)
        process.wait()
        self._process_ended.set()

    def _copy_log(self, service: _Service, stream: IO[bytes]) -> None:
        log = LogFile(service.log_path, self._warn)
        kind = kind_of(service.name)
        with stream, contextlib.closing(log):
            for line in stream:
                log.write(line)
                # Log lines are JSON; only the final error of `services.process` starts like this.
                if line.startswith((f"{kind}:".encode(), f"{kind}.".encode())):
                    service.error = line.decode("utf-8", "replace").rstrip()  # `check` raises it
                elif text := _console_text(line):
                    self._print(prefix_name(service.name, text))

    def _warn(self, text: str) -> None:
        self._print(text, "yellow")

    def _print(self, text: str, style: str | None = None) -> None:
        with contextlib.suppress(OSError):  # the console is a file on a full disk
            self._console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _console_text(line: bytes) -> str:
    """Return what the console shows of a log line: warnings, errors, and text that is not JSON.

    The text of a warning or an error names its session.
    """
    try:
        entry = json.loads(line)
        if entry["level"] not in ("warning", "error", "critical"):
            return ""
        text = "\n".join(str(entry[key]) for key in ("message", "traceback") if key in entry)
        session = entry.get("session", "")
        return text if not session or repr(session) in text else f"session {session!r}: {text}"
    except (ValueError, KeyError, TypeError):
        return line.decode("utf-8", "replace").rstrip()
