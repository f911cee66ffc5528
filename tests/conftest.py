"""Fixtures for all tests."""

import gc
import os
from collections.abc import Collection, Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from kouxing.services.service_kinds import KINDS
from tests.system import System
from tests.videos import write_video

HAS_FAILED = pytest.StashKey[bool]()
settings.register_profile(
    "kouxing", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("kouxing")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Pause the garbage collector, which would take a third of the time of the imports."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()  # the modules stay in memory, so pytest's final collections can skip them
        gc.enable()


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark a test with the name of its folder: unit, property, e2e, …."""
    item.add_marker(item.path.parent.name)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Fail skipped tests in continuous integration, where everything that tests need exists."""
    report = yield
    if report.skipped and os.environ.get("FAIL_SKIPPED_TESTS"):
        report.outcome = "failed"
    item.stash[HAS_FAILED] = report.when == "call" and report.failed
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """After a failed test, tear down all fixtures: their state may have changed.

    The next test gets new services and pages, so one fault makes only one test fail.
    """
    if item.stash.get(HAS_FAILED, False):
        item.session._setupstate.teardown_exact(None)


@pytest.fixture(scope="session", autouse=True)
def _own_keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep tests away from the keys of the user who runs them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture
def new_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the test begin without any key."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture(scope="module")
def services() -> Collection[str]:
    """The services of the system; modules that need fewer override this."""
    return KINDS


@pytest.fixture(scope="module")  # an idle system costs more than a start
def system(services: Collection[str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """A system on this host."""
    with System(services, tmp_path_factory.mktemp("system")) as running:
        yield running


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny video with sound."""
    path = tmp_path_factory.mktemp("video") / "video.mp4"
    write_video(path)
    return path
