"""A supervised system for tests: services that crash are restarted, as in ``kouxing run``."""

from __future__ import annotations

import io
import os
import signal
import time
from pathlib import Path

from kouxing_client import Client
from rich.console import Console

from kouxing.evaluation.system.systems import LocalSystem
from tests.system import own_environment


class Watched(LocalSystem):
    """All services under a supervisor; ``shown`` is what it prints."""

    def __init__(self, folder: Path) -> None:
        environment = own_environment(folder)
        self.page = f"http://127.0.0.1:{environment['KOUXING_GATEWAY_PORT']}/"
        self.shown = io.StringIO()
        super().__init__(folder, Console(file=self.shown, width=200), settings=environment)

    def instance(self, client: Client, service: str) -> str:
        services = client.status().services
        return next((state.instance for state in services if state.service == service), "")

    def kill(self, service: str) -> None:
        os.kill(self.supervisor.process_number(service), signal.SIGKILL)

    def until_replaced(self, client: Client, service: str, old: str) -> None:
        end_s = time.monotonic() + 100
        while self.instance(client, service) in ("", old):
            assert time.monotonic() < end_s, f"{service} did not come back"
            time.sleep(0.05)
