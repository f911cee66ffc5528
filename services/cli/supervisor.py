"""All services on one machine: started, watched, started again when one crashes or hangs."""

from __future__ import annotations

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

from rich.console import Console

from kouxing.services.cli.service_process import BLOCKED_S, LOOK_S, WORKED_S, ServiceProcess
from kouxing.services.kinds import KINDS, WORKERS, kind_of
from kouxing.shared.client import Client
from kouxing.shared.errors import UserError
from kouxing.shared.service import DRAIN_LIMIT_S

BACKOFF_S = (0.2, 5.0)  # least and longest wait before a service that crashed twice starts again
STEADY_S = 30.0  # after which a crash counts as the first one again
STANDBY_S = 3.0  # after the newest start, so that it has the processor for itself
USER_ERROR = 2  # exit status of a service that was configured wrongly
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


class Supervisor:
    """Runs every service as a process of its own.

    Parameters
    ----------
    arguments
        Passed to every service, such as ``["--config", "my.toml"]``.
    log_folder
        One log of JSON lines a service; warnings also go to the console.
    environment
        Added to this process's own.
    services
        Which to run.
    more
        Additions to the environment for more workers of their kinds, by name, as
        ``kouxing.services.kinds.more_workers`` returns them.
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
        self._services = (*services, *self._more)
        self._arguments = arguments
        self._log_folder = log_folder
        self._console = console
        self._environment = {**os.environ, **ONE_THREAD, **(environment or {})}
        self._processes: dict[str, ServiceProcess] = {}
        self._standby: ServiceProcess | None = None  # becomes what crashes next
        self._started_s: dict[str, float] = {}
        self._wait_s = dict.fromkeys(self._services, 0.0)
        self._due_s: dict[str, float] = {}
        self._watcher: threading.Thread | None = None
        self._stopping = threading.Event()
        self._ended = threading.Event()  # a service has ended
        self._failure: UserError | None = None
        log_folder.mkdir(parents=True, exist_ok=True)

    def start(self) -> None:
        """Start every service."""
        for service in self._services:
            self._spawn(service)

    def wait_ready(self, control: str, deadline_s: float = 120.0) -> None:
        """Wait until all services have registered with control.

        Raises
        ------
        UserError
            If a service cannot start, or takes longer than the deadline.
        """
        end_s = time.monotonic() + deadline_s
        with Client(control, deadline_s=2.0) as client:
            while time.monotonic() < end_s:
                self.check()
                with contextlib.suppress(UserError):
                    ready = Counter(service.service for service in client.status().services)
                    if ready >= Counter(map(kind_of, self._services)):
                        return
                time.sleep(0.1)
        raise UserError(f"the services did not start; their logs are in {self._log_folder}")

    @staticmethod
    def page_address(control: str) -> str:
        """Return where the gateway serves the page, with the token if it needs one."""
        with Client(control) as client:
            gateways = [each for each in client.status().services if each.service == "gateway"]
        return gateways[0].endpoints["page"].removesuffix("/")

    def watch(self) -> None:
        """From now on start crashed services again, whatever this thread does; see ``wait``."""
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    def wait(self) -> None:
        """Wait for ever.

        Raises
        ------
        UserError
            If a watched service says that it is configured wrongly.
        """
        while not self._stopping.wait(LOOK_S):
            if self._failure is not None:
                raise self._failure

    def _watch(self) -> None:
        while not self._stopping.is_set():
            self._ended.wait(LOOK_S)
            self._ended.clear()
            try:
                self.check()
            except UserError as error:
                self._failure = error
                return

    def check(self) -> None:
        """Start crashed services again, and end those that hang.

        Raises
        ------
        UserError
            If a service says that it is configured wrongly.
        """
        now_s = time.monotonic()
        for service, process in list(self._processes.items()):
            status = process.poll()
            if status is None:
                if process.hangs(WORKED_S if kind_of(service) in WORKERS else BLOCKED_S):
                    self._console.print(f"[yellow]{service} hangs; ending it")
                    process.kill()
                continue
            if status == USER_ERROR:
                raise UserError(f"{service} cannot start; see above")
            del self._processes[service]
            if now_s - self._started_s[service] > STEADY_S:
                self._wait_s[service] = 0.0
            wait_s = self._wait_s[service]
            self._wait_s[service] = min(max(2 * wait_s, BACKOFF_S[0]), BACKOFF_S[1])
            self._due_s[service] = now_s + wait_s
            when = f"in {wait_s:g} s" if wait_s else "at once"
            self._console.print(
                f"[yellow]{service} ended with status {status}; starting it again {when}"
            )
        for service, due_s in list(self._due_s.items()):
            if now_s >= due_s:
                del self._due_s[service]
                self._spawn(service)
        all_settled = now_s > max(self._started_s.values()) + STANDBY_S
        if self._watcher is not None and self._standby is None and all_settled:
            self._standby = self._run("standby", stdin=subprocess.PIPE)

    def process_number(self, service: str) -> int:
        """Return the process number of a running service."""
        return self._processes[service].pid

    def stop(self) -> None:
        """Ask every service to finish, and end those that do not."""
        self._stopping.set()
        if self._watcher is not None:
            self._watcher.join()
        for process in self._processes.values():
            process.send_signal(signal.SIGTERM)
        end_s = time.monotonic() + DRAIN_LIMIT_S + 1.0
        for process in self._processes.values():
            try:
                process.wait(max(0.1, end_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()
        if self._standby is not None:
            with self._standby as process:
                process.kill()

    def _spawn(self, service: str) -> None:
        kind, environment = kind_of(service), self._more.get(service, {})
        process = self._told_to_become(kind, environment) or self._run(
            kind, self._arguments, environment
        )
        self._processes[service] = process
        self._started_s[service] = time.monotonic()
        follow = threading.Thread(target=self._follow, args=(service, process), daemon=True)
        follow.start()

    def _told_to_become(self, kind: str, environment: Mapping[str, str]) -> ServiceProcess | None:
        """Let the process that stands by be a service; return it, or None where it cannot."""
        process, self._standby = self._standby, None
        if process is None or process.stdin is None:
            return None
        order = {"service": kind, "arguments": self._arguments, "environment": {**environment}}
        try:
            with process.stdin as pipe:
                pipe.write(json.dumps(order).encode() + b"\n")
        except BrokenPipeError:  # it has ended itself
            with process:
                return None
        return process

    def _run(
        self,
        module: str,
        arguments: Collection[str] = (),
        environment: Mapping[str, str] | None = None,
        stdin: int = subprocess.DEVNULL,
    ) -> ServiceProcess:
        return ServiceProcess(
            module,
            arguments,
            environment={**self._environment, **(environment or {})},
            stdin=stdin,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C reaches the supervisor alone, which asks in order
        )

    def _follow(self, service: str, process: subprocess.Popen[bytes]) -> None:
        """Write a service's log until it ends, and say so at once."""
        if process.stderr is not None:
            self._follow_log(service, process.stderr)
        process.wait()
        self._ended.set()

    def _follow_log(self, service: str, stream: IO[bytes]) -> None:
        with stream, (self._log_folder / f"{service}.log").open("ab") as log:
            for line in stream:
                log.write(line)
                log.flush()
                text = _as_warning(line)
                if text:
                    self._console.print(f"{service}: {text}", markup=False, highlight=False)


def _as_warning(line: bytes) -> str:
    """Return what the console shows of a log line: warnings, errors, and what is no JSON."""
    try:
        entry = json.loads(line)
        if entry["level"] not in ("warning", "error", "critical"):
            return ""
        return "\n".join(str(entry[key]) for key in ("message", "traceback") if key in entry)
    except (ValueError, KeyError, TypeError):
        return line.decode("utf-8", "replace").rstrip()
