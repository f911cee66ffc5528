"""A supervised system for tests: services that crash are started again, as in ``kouxing run``."""

from __future__ import annotations

import io
import os
import signal
import time
from pathlib import Path
from typing import Self

from kouxing_client import Client
from rich.console import Console

from kouxing.services.cli.supervisor import Supervisor
from kouxing.services.kinds import more_workers, read_settings
from kouxing.shared.keys import control_endpoint
from tests.system import own_environment


class Watched:
    """A supervisor on ports of its own, which watches as in ``kouxing run``: beside other work."""

    def __init__(self, folder: Path, *, workers: int = 1) -> None:
        environment = own_environment(folder)
        self.control = control_endpoint(environment["KOUXING_CONTROL"], insecure=False)
        self.page = f"http://127.0.0.1:{environment['KOUXING_GATEWAY_PORT']}/"
        self.shown = io.StringIO()
        console = Console(file=self.shown, width=200)
        more = more_workers(read_settings(), workers)
        self.supervisor = Supervisor([], folder, console, environment, more=more)

    def __enter__(self) -> Self:
        try:
            self.supervisor.start()
            self.supervisor.wait_ready(self.control)
            self.supervisor.watch()
        except BaseException:
            self.supervisor.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.supervisor.stop()
        print(self.shown.getvalue())  # shown with a test that failed

    def instance(self, client: Client, service: str) -> str:
        for state in client.status().services:
            if state.service == service:
                return state.instance
        return ""

    def kill(self, service: str) -> None:
        os.kill(self.supervisor.process_number(service), signal.SIGKILL)

    def until_replaced(self, client: Client, service: str, old: str) -> None:
        end_s = time.monotonic() + 100
        while self.instance(client, service) in ("", old):
            assert time.monotonic() < end_s, f"{service} did not come back"
            time.sleep(0.05)
