"""What all tests share: how they are spread over processes, and a running system."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

from tests.system import System

STARTS_SERVICES = {"bench", "e2e", "process"}  # folders whose tests start services

settings.register_profile(
    "kouxing", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("kouxing")


class FileScheduling(LoadScopeScheduling):  # type: ignore[misc] # untyped
    """Each file's tests run in one process, and all that start services in the same one."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return "services" if Path(file).parts[1] in STARTS_SERVICES else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> FileScheduling:
    """Spread the tests over processes, where pytest is told to use some (``-n 2``)."""
    return FileScheduling(config, log)


@pytest.fixture(scope="session", autouse=True)
def _own_keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No test touches the keys of whoever runs it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """Control, recognizer, synthesizer and driver on this host."""
    folder = tmp_path_factory.mktemp("system")
    with System(("control", "recognizer", "synthesizer", "driver"), folder) as running:
        yield running
