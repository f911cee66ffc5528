"""All services on one machine: started, watched, and started again when one crashes."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from rich.console import Console

from services.kinds import KINDS
from shared.client import Client
from shared.errors import UserError
from shared.service import DRAIN_LIMIT_S, PARENT_VARIABLE

BACKOFF_S = (0.2, 5.0)  # first and longest wait before a crashed service starts again
CHECK_EVERY_S = 0.2
STEADY_S = 30.0  # after which a crash counts as the first one again
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
    """

    def __init__(
        self,
        arguments: list[str],
        log_folder: Path,
        console: Console,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._arguments = arguments
        self._log_folder = log_folder
        self._console = console
        self._environment = {**os.environ, **ONE_THREAD, **(environment or {})}
        self._environment[PARENT_VARIABLE] = str(os.getpid())
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._started_s: dict[str, float] = {}
        self._wait_s = dict.fromkeys(KINDS, BACKOFF_S[0])
        self._due_s: dict[str, float] = {}
        self._watcher: threading.Thread | None = None
        self._stopping = threading.Event()
        self._failure: UserError | None = None
        log_folder.mkdir(parents=True, exist_ok=True)

    def start(self) -> None:
        """Start every service."""
        for service in KINDS:
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
                    ready = {service.service for service in client.status().services}
                    if ready >= set(KINDS):
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
        while not self._stopping.wait(CHECK_EVERY_S):
            if self._failure is not None:
                raise self._failure

    def _watch(self) -> None:
        while not self._stopping.wait(CHECK_EVERY_S):
            try:
                self.check()
            except UserError as error:
                self._failure = error
                return

    def check(self) -> None:
        """Start crashed services again.

        Raises
        ------
        UserError
            If a service says that it is configured wrongly.
        """
        now_s = time.monotonic()
        for service, process in list(self._processes.items()):
            status = process.poll()
            if status is None:
                continue
            if status == USER_ERROR:
                raise UserError(f"{service} cannot start; see above")
            del self._processes[service]
            if now_s - self._started_s[service] > STEADY_S:
                self._wait_s[service] = BACKOFF_S[0]
            wait_s = self._wait_s[service]
            self._wait_s[service] = min(2 * wait_s, BACKOFF_S[1])
            self._due_s[service] = now_s + wait_s
            self._console.print(
                f"[yellow]{service} ended with status {status}; starting it again in {wait_s:g} s"
            )
        for service, due_s in list(self._due_s.items()):
            if now_s >= due_s:
                del self._due_s[service]
                self._spawn(service)

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

    def _spawn(self, service: str) -> None:
        process = subprocess.Popen(  # noqa: S603 - our own module
            [sys.executable, "-m", f"services.{service}", *self._arguments],
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C reaches the supervisor alone, which asks in order
        )
        self._processes[service] = process
        self._started_s[service] = time.monotonic()
        if process.stderr is not None:
            follow = threading.Thread(
                target=self._follow_log, args=(service, process.stderr), daemon=True
            )
            follow.start()

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
