"""What all tests share: how they are spread over processes, and a running system."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

from tests.system import System
from tests.videos import write_video

STARTS_SERVICES = {"bench", "e2e", "process"}  # folders whose tests start services
THIRD = "gw2"  # of the processes

settings.register_profile(
    "kouxing", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("kouxing")


class FileScheduling(LoadScopeScheduling):  # type: ignore[misc] # untyped
    """Each file's tests run in one process; the third begins with those that start no services."""

    def _split_scope(self, nodeid: str) -> str:
        return nodeid.partition("::")[0]

    def _assign_work_unit(self, node: WorkerController) -> None:
        if node.gateway.id == THIRD:
            self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
        super()._assign_work_unit(node)


def pytest_configure() -> None:
    """Let services and the tests that wait for them come before what the third process does."""
    if os.environ.get("PYTEST_XDIST_WORKER") == THIRD:
        os.nice(10)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests that start services, which take longest; run one that fails once more.

    They run in real time: when the machine stands still for a moment, live frames are left out.
    """
    items.sort(key=lambda item: not _starts_services(item))
    for item in filter(_starts_services, items):
        item.add_marker(pytest.mark.flaky(reruns=1))


def _starts_services(item: pytest.Item) -> bool:
    return Path(item.nodeid).parts[1] in STARTS_SERVICES


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


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny video with sound."""
    path = tmp_path_factory.mktemp("video") / "video.mp4"
    write_video(path)
    return path
