"""Runs all services on one machine, and restarts a service that crashes or hangs."""

import contextlib
import json
import os
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO

from kouxing_client import KouxingError
from rich.console import Console

from kouxing.services.cli.log_file import LogFile
from kouxing.services.cli.service_process import HANG_S, POLL_S, ServiceProcess
from kouxing.services.service_kinds import KINDS, WORKERS, kind_of
from kouxing.shared.client_connection import connect_client
from kouxing.shared.errors import USER_ERROR, UserError, prefix_name
from kouxing.shared.service import DRAIN_TIMEOUT_S

MIN_BACKOFF_S, MAX_BACKOFF_S = 0.2, 5.0  # delays before restarting a service that crashed twice
START_LIMIT_S = 120.0
STEADY_S = 10.0  # a service that has run for longer restarts without delay
WORKER_HANG_S = 2.0  # workers never work for long at a time, unless the machine is overloaded


class Supervisor:
    """Runs each service in a process, with one log of JSON lines per service in ``log_folder``.

    Warnings also go to the console. ``arguments`` are the command-line arguments of every service,
    and ``environment`` is added to this process's. ``more`` names additional workers, such as
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
        more: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        self._more = more or {}
        self._names = (*services, *self._more)
        self._arguments = arguments
        self._log_folder = log_folder
        self._console = console
        self._environment = {**os.environ, **(environment or {})}
        self._processes: dict[str, ServiceProcess] = {}
        self._started_s: dict[str, float] = {}
        self._backoff_s = dict.fromkeys(self._names, 0.0)
        self._restart_at_s: dict[str, float] = {}
        self._restarted: set[str] = set()  # services that are not ready again
        self._followers: dict[str, threading.Thread] = {}  # threads that copy the logs
        self._errors: dict[str, str] = {}  # newest error in the configuration
        self._watcher: threading.Thread | None = None
        self._stopping = threading.Event()
        self._process_ended = threading.Event()
        self._failure: UserError | None = None
        path = log_folder
        try:
            log_folder.mkdir(parents=True, exist_ok=True)
            for path in map(self._log_path, self._names):
                LogFile(path, self._warn).check()
        except OSError as error:
            raise UserError(
                f"cannot write {path}: {error.strerror}; start kouxing in a folder that"
                " you can write to, or add --set driver.out=FOLDER"
            ) from None

    def start(self) -> None:
        """Start every service."""
        for name in self._names:
            self._start(name)

    def wait_ready(self, control: str) -> None:
        """Wait until all services have registered with control.

        Raises ``UserError`` if a service cannot start, or this takes longer than ``START_LIMIT_S``.
        """
        end_s = time.monotonic() + START_LIMIT_S
        with connect_client(control, timeout_s=2.0) as client:
            while time.monotonic() < end_s:
                self.check()
                with contextlib.suppress(KouxingError):  # control does not run yet
                    ready = Counter(service.service for service in client.status().services)
                    if ready >= Counter(map(kind_of, self._names)):
                        return
                time.sleep(0.1)
        raise UserError(f"the services did not start; see their logs in {self._log_folder}")

    @staticmethod
    def page_address(control: str) -> str:
        """Return the address of the gateway's page, including its token."""
        with connect_client(control) as client:
            services = client.status().services
        gateway = next(service for service in services if service.service == "gateway")
        return gateway.endpoints["page"].removesuffix("/")

    def watch(self) -> None:
        """Restart crashed services from now on, in a thread; see also ``wait``."""
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    def wait(self) -> None:
        """Wait until ``stop`` is called.

        Raises ``UserError`` if a service reports a wrong configuration.
        """
        self._stopping.wait()
        if self._failure is not None:
            raise self._failure

    def check(self) -> None:
        """Kill services that hang, and restart those that have ended.

        Raises ``UserError`` if a service reports a wrong configuration.
        """
        now_s = time.monotonic()
        processes = self._processes.values()
        for process in processes:
            process.read_heartbeats()
        if len(processes) > 1 and all(process.is_silent for process in processes):
            for process in processes:  # all processes were stopped, so none of them hangs
                process.reset_silence()
        for name, process in list(self._processes.items()):
            status = process.poll()
            if status is None:
                if process.hangs:
                    self._warn(f"{name} hangs; killing it")
                    process.kill()
                elif process.is_ready and name in self._restarted:
                    self._restarted.remove(name)
                    self._print(f"{name} is running again", "green")
            elif status == USER_ERROR:
                self._followers[name].join()
                missing = f"{name} cannot start; see {self._log_path(name)}"
                raise UserError(self._errors.get(name, missing))
            else:
                self._schedule_restart(name, status, now_s)
        for name, restart_at_s in list(self._restart_at_s.items()):
            if now_s >= restart_at_s:
                del self._restart_at_s[name]
                self._restarted.add(name)
                self._start(name)

    def process(self, name: str) -> ServiceProcess:
        """Return the process of a running service."""
        return self._processes[name]

    def stop(self) -> None:
        """Ask every service to stop, and kill those that do not stop in time."""
        self._stopping.set()
        if self._watcher is not None:
            self._watcher.join()
        for process in self._processes.values():
            process.send_signal(signal.SIGTERM)
        end_s = time.monotonic() + DRAIN_TIMEOUT_S + 1.0
        for process in self._processes.values():
            try:
                process.wait(max(0.1, end_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()

    def _watch(self) -> None:
        while not self._stopping.is_set():
            self._process_ended.wait(POLL_S)
            self._process_ended.clear()
            try:
                self.check()
            except UserError as error:
                self._failure = error
                self._stopping.set()

    def _schedule_restart(self, name: str, status: int, now_s: float) -> None:
        del self._processes[name]
        is_steady = now_s - self._started_s[name] > STEADY_S
        wait_s = 0.0 if is_steady else self._backoff_s[name]
        self._backoff_s[name] = min(max(2 * wait_s, MIN_BACKOFF_S), MAX_BACKOFF_S)
        self._restart_at_s[name] = now_s + wait_s
        when = f"in {wait_s:g} s" if wait_s else "now"
        self._warn(f"{name} ended with status {status}; restarting it {when}")

    def _start(self, name: str) -> None:
        process = ServiceProcess(
            kind_of(name),
            self._arguments,
            environment={**self._environment, **self._more.get(name, {})},
            hang_limit_s=self._hang_limit_s(name),
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C must reach only the supervisor
        )
        self._processes[name] = process
        self._started_s[name] = time.monotonic()
        follower = threading.Thread(
            target=self._copy_log_until_end, args=(name, process), daemon=True
        )
        self._followers[name] = follower
        follower.start()

    def _hang_limit_s(self, name: str) -> float:
        """Return the hang limit: short for a worker, unless it has already been restarted twice."""
        is_fresh = self._backoff_s[name] <= MIN_BACKOFF_S
        return WORKER_HANG_S if kind_of(name) in WORKERS and is_fresh else HANG_S

    def _copy_log_until_end(self, name: str, process: subprocess.Popen[bytes]) -> None:
        """Copy a service's log until it ends, then wake the watcher."""
        if process.stderr is not None:
            self._copy_log(name, process.stderr)
        process.wait()
        self._process_ended.set()

    def _log_path(self, name: str) -> Path:
        return self._log_folder / f"{name}.log"

    def _copy_log(self, name: str, stream: IO[bytes]) -> None:
        log = LogFile(self._log_path(name), self._warn)
        with stream, contextlib.closing(log):
            for line in stream:
                log.write(line)
                text = _console_text(line)
                if text.startswith((f"{kind_of(name)}:", f"{kind_of(name)}.")):
                    self._errors[name] = text  # `check` raises it
                elif text:
                    self._print(prefix_name(name, text))

    def _warn(self, text: str) -> None:
        self._print(text, "yellow")

    def _print(self, text: str, style: str | None = None) -> None:
        with contextlib.suppress(OSError):  # the console is a file on a full disk
            self._console.print(text, style=style, markup=False, highlight=False)


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
